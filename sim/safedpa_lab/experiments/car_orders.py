"""Which drives the car experiment records, with which seeds; no seed serves two ends."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from safedpa.errors import InputError
from safedpa.safety import FilterSettings
from safedpa_lab.experiments.car_drives import DriveOrder
from safedpa_lab.experiments.car_scenes import TICKS

__all__ = [
    "EARNEST",
    "FIRST_SEEDS",
    "check_episode_seeds",
    "earnest_orders",
    "hitching_orders",
    "open_orders",
    "path_orders",
]

FIRST_SEEDS = {"margin": 5000, "fresh": 6000, "errors": 7000, "latent": 8000, "hitching": 9000, "paths": 9500}
"""First seed of the drives that calibrate margins, check their coverage, measure errors (and test the classifier of
latents), fit that classifier, change the load on the way, and show predicted paths. The table's episodes have seeds
from 0."""

HITCHED, LET_GO = 3, 5
"""Eighths of a hitching drive after which the load is hitched, and let go again."""


EARNEST = 4
"""Drives in earnest for every other recorded drive: they end at the goal, after a fifth of the time or so."""


def check_episode_seeds(first: int, episodes: int) -> None:
    """Raises InputError for episodes whose seeds are those of recorded drives."""
    if not 0 <= first <= FIRST_SEEDS["margin"] - episodes:
        raise InputError(
            f"first seed: got {first} with {episodes} episodes, wanted seeds from 0 and below "
            f"{FIRST_SEEDS['margin']}, where those of the recorded drives begin"
        )


def earnest_orders(
    loads: Sequence[str], each: int, purpose: str, method: str, folder: Path, settings: FilterSettings
) -> list[DriveOrder]:
    """A method in scenes of the experiment; ``purpose`` is a key of FIRST_SEEDS."""
    first = FIRST_SEEDS[purpose]
    return [
        DriveOrder(first + index, load, TICKS, method, folder, settings)
        for load in loads
        for index in range(EARNEST * each)
    ]


def open_orders(loads: Sequence[str], each: int, ticks: int, purpose: str) -> list[DriveOrder]:
    """Exploring drives on an open field, one load each; ``purpose`` is a key of FIRST_SEEDS."""
    first = FIRST_SEEDS[purpose]
    return [DriveOrder(first + index, load, ticks) for load in loads for index in range(each)]


def path_orders(loads: Sequence[str], ticks: int) -> list[DriveOrder]:
    """The goal seeker on an open field, from the same start to the same goals with every load."""
    return [DriveOrder(FIRST_SEEDS["paths"], load, ticks, exploring=False) for load in loads]


def hitching_orders(loads: Sequence[str], each: int, ticks: int) -> list[DriveOrder]:
    """Exploring drives that begin without load; it is hitched on the way, and let go later."""
    events = (ticks * HITCHED // 8, ticks * LET_GO // 8)
    first = FIRST_SEEDS["hitching"]
    return [
        DriveOrder(first + index, "none", ticks, events=((events[0], load), (events[1], "none")))
        for load in loads
        if load != "none"
        for index in range(each)
    ]
