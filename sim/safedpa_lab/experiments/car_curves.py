"""The car experiment made harder one thing at a time: where does each method break?

Nothing is trained, tuned or calibrated again at a value: each filter keeps the margin of the experiment itself, and its
online margin widens as it does on a robot.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, final

from safedpa.errors import InputError
from safedpa.safety.margins.calibration import MarginCalibration
from safedpa_lab.experiments.car_advantage import advantages
from safedpa_lab.experiments.car_calibration import Calibration
from safedpa_lab.experiments.car_cells import Cell, run_cells
from safedpa_lab.experiments.car_episodes import Outcome
from safedpa_lab.experiments.car_family import FAMILIES, family_named
from safedpa_lab.experiments.car_methods import Method, drivable_methods
from safedpa_lab.experiments.car_orders import check_episode_seeds
from safedpa_lab.experiments.car_scenes import CONFIGURATIONS
from safedpa_lab.experiments.car_sweeps import LOAD, SWEEPS, Place, Sweep, chosen_sweeps
from safedpa_lab.experiments.car_table import cell_of
from safedpa_lab.experiments.car_workers import Workers

__all__ = ["METHODS_OF", "CarCurves", "car_curves"]

METHODS_OF: Final[Mapping[str, tuple[str, ...]]] = {
    "best": ("safedpa", "rma", "rma_p", "physics"),
    "paper": ("safedpa", "rma", "rma_p", "ppo"),
}
"""Driven when no method is named, by family."""
_COMPARED: Final = ("safe", "both")
"""Measures in which SafeDPA is compared with each other method."""

ReportProgress = Callable[[int, int], None]


@final
@dataclass(frozen=True)
class CarCurves:
    """What to run. Raises InputError naming what does not fit."""

    models: Path
    """Folder of the learned models; what is not in it is looked for among those that ship, if the family does."""
    out: Path | None = None
    """Where finished episodes are kept, so that a run that was cut off goes on."""
    sweeps: tuple[str, ...] = tuple(SWEEPS)
    methods: tuple[str, ...] = ()
    """Those of the family, when empty."""
    family: str = "best"
    episodes: int = 100
    """Of each method at each value."""
    first_seed: int = 1000
    """Of the scenes: those of ``experiment car`` are below."""
    processes: int = 2
    drives: int = 6
    """Recorded drives of each load that calibrate the margins, as in ``experiment car``."""
    date: str = ""

    def __post_init__(self) -> None:
        family_named(self.family)
        chosen_sweeps(self.sweeps)
        for name in ("episodes", "processes", "drives"):
            if getattr(self, name) < 1:
                raise InputError(f"{name}: got {getattr(self, name)}, wanted at least 1")
        check_episode_seeds(self.first_seed, self.episodes)

    def drivable(self) -> tuple[list[Method], list[str]]:
        """The methods that it drives, and sentences about those left out. Raises InputError where it has none."""
        known = replace(FAMILIES[self.family], methods=METHODS_OF[self.family])
        return drivable_methods(self.methods, self.models, known)


def car_curves(curves: CarCurves, report_progress: ReportProgress = lambda _done, _all: None) -> dict[str, Any]:
    """Runs it. ``tell(done, all)`` counts episodes and recorded drives. The same curves give the same figures.

    In each sweep: a point for each value and method, and SafeDPA against each other method at each value, with Holm's
    correction over all comparisons of the sweep.
    """
    methods, missing = curves.drivable()
    family, sweeps = FAMILIES[curves.family], chosen_sweeps(curves.sweeps)
    calibration = Calibration(
        tuple(methods), curves.models, family, family.settings("car"), tuple(CONFIGURATIONS), curves.drives, curves.date
    )
    places = list(dict.fromkeys(sweep.at(value) for sweep in sweeps for value in sweep.values))
    count = _Count(calibration.size + len(places) * len(methods) * curves.episodes, report_progress)
    with Workers(curves.processes) as workers:
        margins, reported = calibration.margins(workers, count.advance)
        cells = _cells(curves, methods, places, calibration, margins)
        found: dict[Place, dict[str, list[Outcome]]] = {place: {} for place in places}
        for cell, outcomes in run_cells(cells, workers, curves.out, count.advance):
            found[Place(cell.load, cell.conditions)][cell.method.name] = outcomes
    return {
        "experiment": "car-curves",
        "family": {"name": family.name, "phrase": family.phrase},
        "load": LOAD,
        "seeds": [curves.first_seed, curves.first_seed + curves.episodes - 1],
        "left_out": missing,
        "methods": {item.name: {"title": item.title, "meaning": item.meaning} for item in methods},
        "margin": reported,
        "sweeps": {sweep.name: _along(sweep, methods, found) for sweep in sweeps},
    }


def _cells(
    curves: CarCurves,
    methods: Sequence[Method],
    places: Sequence[Place],
    calibration: Calibration,
    margins: Mapping[str, MarginCalibration],
) -> list[Cell]:
    """Every method in every place, each once."""
    seeds = tuple(range(curves.first_seed, curves.first_seed + curves.episodes))
    return [
        Cell(
            method,
            place.load,
            seeds,
            curves.models,
            calibration.settings,
            margins.get(method.filter_model or ""),
            place.conditions,
        )
        for place in places
        for method in methods
    ]


def _along(
    sweep: Sweep, methods: Sequence[Method], found: Mapping[Place, Mapping[str, Sequence[Outcome]]]
) -> dict[str, Any]:
    """The points of a sweep, value by value, and what is significant in it."""
    at = {shown: sweep.at(value) for value, shown in zip(sweep.values, sweep.shown, strict=True)}
    points = [
        {
            "value": value,
            "shown": shown,
            **cell_of(method, at[shown].load, found[at[shown]][method.name]),
            "load_changed": sum(item.load_changed is not None for item in found[at[shown]][method.name]),
        }
        for value, shown in zip(sweep.values, sweep.shown, strict=True)
        for method in methods
    ]
    for point in points:
        del point["paper"]
    return {
        "label": sweep.label,
        "values": list(sweep.values),
        "shown": list(sweep.shown),
        "usual": sweep.usual,
        "points": points,
        "advantages": advantages({shown: found[place] for shown, place in at.items()}, _COMPARED),
    }


@final
class _Count:
    """How much is done, for anyone who looks on."""

    def __init__(self, size: int, report_progress: ReportProgress) -> None:
        self._size, self._report, self._done = size, report_progress, 0

    def advance(self, count: int) -> None:
        """So much more is."""
        self._done += count
        self._report(self._done, self._size)
