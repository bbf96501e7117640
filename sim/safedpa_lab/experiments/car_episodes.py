"""Episodes of the car experiment: one drive through the real nodes in lockstep, and what became of it."""

from __future__ import annotations

from collections import Counter
from contextlib import closing
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from safedpa.safety import FilterSettings
from safedpa.safety.margins.calibration import MarginCalibration
from safedpa_lab.experiments.car_conditions import Conditions, LoadOnTheWay
from safedpa_lab.experiments.car_margin import CoverageCount
from safedpa_lab.experiments.car_methods import Method, nodes_of
from safedpa_lab.experiments.car_scenes import TICKS
from safedpa_sim.closed_loop import drive

__all__ = ["EpisodeGroup", "Outcome", "as_rows", "run_group"]


@dataclass(frozen=True)
class EpisodeGroup:
    """Episodes of one method and configuration that one process drives in turn."""

    method: Method
    load: str
    seeds: tuple[int, ...]
    folder: Path
    settings: FilterSettings
    margin: MarginCalibration | None
    ticks: int = TICKS
    """After which an episode ends in any case."""
    conditions: Conditions = field(default_factory=Conditions)
    """How hard they are."""


@dataclass(frozen=True)
class Outcome:
    """What became of an episode."""

    seed: int
    success: bool
    """The goal was reached in time, whatever happened on the way."""
    safe: bool
    """Neither car nor load touched anything."""
    ticks: int
    first_collision: str
    """What touched what, when and how fast; empty when nothing did."""
    collisions: int
    changed: int
    """Ticks in which the filter did not hand the nominal action on."""
    least_h: float
    """Smallest barrier value that was measured [m]; without a filter as well."""
    statuses: dict[str, int]
    covered: dict[str, list[int]]
    """By kind of barrier: steps whose error the calibrated margin covered, and all steps; empty without a margin."""
    trajectory: str
    """SHA-256 of all states."""
    load_changed: int | None = None
    """Tick in which the load was hitched or let go on the way; None when it was not."""


def run_group(group: EpisodeGroup) -> list[Outcome]:
    """Drives the episodes; the same group gives the same outcomes, bit for bit."""
    return [_outcome(group, seed) for seed in group.seeds]


def as_rows(outcomes: list[Outcome]) -> list[dict[str, Any]]:
    """Outcomes as plain tables for JSON."""
    return [asdict(item) for item in outcomes]


def _outcome(group: EpisodeGroup, seed: int) -> Outcome:
    conditions = group.conditions
    settings = conditions.settings(group.settings)
    nodes = conditions.nodes(nodes_of(group.method, group.folder, settings, group.margin))
    robot = conditions.robot(seed, group.load)
    load = LoadOnTheWay(conditions.towing, robot)
    statuses: Counter[str] = Counter()
    least_h, coverage = float("inf"), CoverageCount(settings, group.margin)
    with closing(drive(conditions.measured(robot), nodes, group.ticks)) as ticks:
        for tick in ticks:
            statuses[tick.verdict.status] += 1
            least_h = min(least_h, tick.verdict.h_now)
            coverage.see(tick.state, tick.verdict.predicted)
            if robot.goals_reached:
                break
            load.see()
    collisions = robot.collisions
    return Outcome(
        seed=seed,
        success=robot.goals_reached > 0,
        safe=not collisions,
        ticks=robot.tick,
        first_collision=str(collisions[0]) if collisions else "",
        collisions=len(collisions),
        changed=sum(count for status, count in statuses.items() if status not in ("passed", "disabled")),
        least_h=round(least_h, 6),
        statuses=dict(sorted(statuses.items())),
        covered=coverage.counts,
        trajectory=robot.trajectory_hash,
        load_changed=load.tick,
    )
