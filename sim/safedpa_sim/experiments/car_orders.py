"""Which drives the car experiment records, with which seeds; no seed serves two ends."""

from __future__ import annotations

from collections.abc import Sequence

from safedpa_sim.experiments.car_drives import DriveOrder

__all__ = ["FIRST_SEEDS", "fresh_orders", "hitching_orders", "margin_orders", "open_orders", "path_orders"]

FIRST_SEEDS = {"margin": 5000, "fresh": 6000, "errors": 7000, "latent": 8000, "hitching": 9000, "paths": 9500}
"""First seed of the drives that calibrate margins, check their coverage, measure errors (and test the classifier of
latents), fit that classifier, change the load on the way, and show predicted paths. The table's episodes have seeds
from 0."""

HITCHED, LET_GO = 3, 5
"""Eighths of a hitching drive after which the load is hitched, and let go again."""


def margin_orders(loads: Sequence[str], each: int, ticks: int) -> list[DriveOrder]:
    """Random scenes behind the filter, as the robot drives in earnest: calibration."""
    return _among_obstacles(loads, each, ticks, FIRST_SEEDS["margin"])


def fresh_orders(loads: Sequence[str], each: int, ticks: int) -> list[DriveOrder]:
    """The same with other seeds: to count what the margins cover."""
    return _among_obstacles(loads, each, ticks, FIRST_SEEDS["fresh"])


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


def _among_obstacles(loads: Sequence[str], each: int, ticks: int, first: int) -> list[DriveOrder]:
    return [
        DriveOrder(first + index, load, ticks, among_obstacles=True, exploring=False)
        for load in loads
        for index in range(each)
    ]
