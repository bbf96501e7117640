"""Episodes of the car experiment: one drive through the real nodes in lockstep, and what became of it."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from safedpa.dynamics import fingerprint
from safedpa.records.writers.tables import atomic_path
from safedpa.safety import FilterSettings, write_settings
from safedpa.safety.margins.calibration import MarginCalibration
from safedpa_lab.experiments.car.conditions import TICKS, Conditions, LoadOnTheWay
from safedpa_lab.experiments.car.margin import CoverageCount
from safedpa_lab.experiments.car.methods import Method, named_model, nodes_of
from safedpa_lab.experiments.common.workers import Workers
from safedpa_sim.closed_loop import drive


@dataclass(frozen=True)
class Outcome:
    """The result of an episode."""

    seed: int
    success: bool
    """The goal was reached in time, with or without contacts before."""
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
    """Tick in which the load was hitched or released while driving; None when it was not."""


_AT_ONCE = 5
"""Episodes that one process drives before it reports."""


@dataclass(frozen=True)
class Cell:
    """Episodes of one method and configuration, under the same conditions."""

    method: Method
    load: str
    seeds: tuple[int, ...]
    folder: Path
    settings: FilterSettings
    margin: MarginCalibration | None
    conditions: Conditions = field(default_factory=Conditions)
    """How hard they are."""
    ticks: int = TICKS
    """After which an episode ends in any case."""

    @property
    def key(self) -> str:
        """Changes with everything that the outcomes depend on but the program itself."""
        names = self.method.model, self.method.filter_model or self.method.model
        models = [fingerprint(named_model(name, self.folder)) for name in names]
        epsilon = {} if self.margin is None else self.margin.select(self.settings.margin).epsilon
        settings = write_settings(self.settings)
        reported: list[Any] = [self.method.name, self.load, *models, settings, sorted(epsilon.items())]
        if self.conditions != Conditions():
            reported.append(asdict(self.conditions))
        return hashlib.sha256(json.dumps(reported).encode()).hexdigest()[:16]

    def groups(self, seeds: Sequence[int]) -> list[Cell]:
        """The work of so many seeds, in parts."""
        parts = (tuple(seeds[start : start + _AT_ONCE]) for start in range(0, len(seeds), _AT_ONCE))
        return [replace(self, seeds=part) for part in parts]

    @property
    def name(self) -> str:
        """Of the file in which it is kept."""
        return "-".join(word for word in (self.method.name, self.load, self.conditions.label) if word)


def run_group(cell: Cell) -> list[Outcome]:
    """Drives the episodes; the same cell gives the same outcomes, bit for bit."""
    return [_outcome(cell, seed) for seed in cell.seeds]


def _outcome(cell: Cell, seed: int) -> Outcome:
    conditions = cell.conditions
    settings = conditions.settings(cell.settings)
    nodes = conditions.nodes(nodes_of(cell.method, cell.folder, settings, cell.margin))
    robot = conditions.robot(seed, cell.load)
    load = LoadOnTheWay(conditions.towing, robot)
    statuses: Counter[str] = Counter()
    least_h, coverage = float("inf"), CoverageCount(settings, cell.margin)
    with closing(drive(conditions.measured(robot), nodes, cell.ticks)) as ticks:
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


def run_cells(
    cells: Sequence[Cell], workers: Workers, out: Path | None, report_progress: Callable[[int], None]
) -> Iterator[tuple[Cell, list[Outcome]]]:
    """Each cell with its outcomes; those that lie in ``out`` from before are read, not driven again.

    ``report_progress`` gets the number of episodes that have just been done.
    """
    retained = {index: _read(cell, out) for index, cell in enumerate(cells)}
    work = [
        group
        for index, cell in enumerate(cells)
        for group in cell.groups([seed for seed in cell.seeds if seed not in retained[index]])
    ]
    driven = workers.map(run_group, work)
    for index, cell in enumerate(cells):
        found = retained[index]
        report_progress(len(found))
        for _ in cell.groups([seed for seed in cell.seeds if seed not in found]):
            outcomes = next(driven)
            found.update({item.seed: item for item in outcomes})
            report_progress(len(outcomes))
        _write(cell, found, out)
        yield cell, [found[seed] for seed in cell.seeds]


def _path(cell: Cell, out: Path) -> Path:
    return out / "cells" / f"{cell.name}.json"


def _read(cell: Cell, out: Path | None) -> dict[int, Outcome]:
    """Outcomes by seed from before, if they are of the same models, margins and settings."""
    if out is None or not _path(cell, out).is_file():
        return {}
    table: dict[str, Any] = json.loads(_path(cell, out).read_text(encoding="utf-8"))
    if table["key"] != cell.key:
        return {}
    outcomes = [Outcome(**row) for row in table["episodes"]]
    return {item.seed: item for item in outcomes if item.seed in cell.seeds}


def _write(cell: Cell, found: dict[int, Outcome], out: Path | None) -> None:
    if out is None:
        return
    path = _path(cell, out)
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = [asdict(found[seed]) for seed in sorted(found)]
    with atomic_path(path) as unfinished:
        unfinished.write_text(json.dumps({"key": cell.key, "episodes": rows}) + "\n", encoding="utf-8")
