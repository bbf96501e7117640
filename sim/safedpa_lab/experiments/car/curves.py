"""The car experiment made harder one thing at a time: where does each method break?

Nothing is trained, tuned or calibrated again at a value: each filter keeps the margin of the experiment itself, and its
online margin widens as it does on a robot.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, final

from safedpa.errors import InputError, did_you_mean
from safedpa_lab.experiments.car.conditions import CONFIGURATIONS, HEAVIER, PASSAGE, TOWING, Conditions
from safedpa_lab.experiments.car.episodes import Cell, Outcome, run_cells
from safedpa_lab.experiments.car.experiment import CarRun
from safedpa_lab.experiments.car.methods import FAMILIES, Method, drivable_methods, family_named
from safedpa_lab.experiments.car.report import advantages, cell_of
from safedpa_lab.experiments.common.workers import Progress, Workers
from safedpa_lab.experiments.record import Options, ReportProgress, Result, silent, with_options
from safedpa_sim.robots.car.loads import LOADS

LOAD: Final = "chair"
"""What is towed where the sweep is not about the load: no policy of the paper's family has met it."""

_MASSES: Final[Mapping[float, str]] = {
    0.0: "none",
    **{load.mass_ratio: name for name, load in (*LOADS.items(), *HEAVIER.items())},
}
"""Mass of the load over the car's, and its name."""


@final
@dataclass(frozen=True)
class Place:
    """Where a point of a curve is measured."""

    load: str
    conditions: Conditions


@final
@dataclass(frozen=True)
class Sweep:
    """One thing that is made harder, from easy to hard."""

    name: str
    label: str
    """What the values are, with their unit as they are shown."""
    values: tuple[float, ...]
    """In SI units, or shares; the towing as its place in ``TOWING``."""
    usual: float | None
    """The value of the experiment itself; None where none of the values is."""
    scale: float = 1.0
    """What the values are multiplied by where they are shown."""
    names: tuple[str, ...] = ()
    """The values as text, where they are not shown as numbers."""

    @property
    def shown(self) -> tuple[str, ...]:
        """The values as text, for figures and tables."""
        return self.names or tuple(f"{self.scale * value:g}" for value in self.values)

    def at(self, value: float) -> Place:
        """The load and the conditions at one of the values."""
        if self.name == "load":
            return Place(_MASSES[value], Conditions())
        if value == self.usual:
            return Place(LOAD, Conditions())
        return Place(LOAD, _changed(self.name, value))


def _changed(name: str, value: float) -> Conditions:
    """With one thing changed."""
    if name == "towing":
        return Conditions(towing=TOWING[int(value)])
    if name == "row":
        return Conditions(passage=value, row=True)
    if name == "delay_untold":
        return Conditions(delay=value, reported=False)
    changed: dict[str, Any] = {name: value}
    return Conditions(**changed)


_PASSAGES: Final = (PASSAGE, 0.3, 0.2, 0.1, 0.05)
_DELAYS: Final = (0.0, 0.05, 0.10, 0.15)
_TOWING: Final = {"never": "never", "to_a_third": "up to 1/3", "from_a_third": "from 1/3", "always": "always"}

SWEEPS: Final[Mapping[str, Sweep]] = {
    sweep.name: sweep
    for sweep in (
        Sweep("passage", "room in a passage [m]", _PASSAGES, PASSAGE),
        Sweep("row", "room, no way around [m]", _PASSAGES, None),
        Sweep("load", "load / car, by mass", tuple(_MASSES), LOADS[LOAD].mass_ratio),
        Sweep(
            "towing",
            f"{LOAD} hitched",
            tuple(float(TOWING.index(name)) for name in _TOWING),
            float(TOWING.index("always")),
            names=tuple(_TOWING.values()),
        ),
        Sweep("speed", "speed, x 2 m/s at most", (0.75, 1.0, 1.25, 1.5), 1.0),
        Sweep("friction", "grip of the tyres, x 0.9", (1.0, 0.8, 0.6, 0.4), 1.0),
        Sweep("noise", "noise of x and y [cm]", (0.0, 0.01, 0.02, 0.04), 0.0, 100.0),
        Sweep("delay", "delay, known to the filter [ms]", _DELAYS, 0.0, 1000.0),
        Sweep("delay_untold", "delay, not known to the filter [ms]", _DELAYS, 0.0, 1000.0),
    )
}
"""Each from easy to hard."""


def chosen_sweeps(names: tuple[str, ...]) -> list[Sweep]:
    """Those of these names, all without any. Raises InputError for a name that there is not."""
    for name in names:
        if name not in SWEEPS:
            raise InputError(f"sweep '{name}': {did_you_mean(name, SWEEPS)}")
    return [sweep for sweep in SWEEPS.values() if not names or sweep.name in names]


METHODS_OF: Final[Mapping[str, tuple[str, ...]]] = {
    "best": ("safedpa", "rma", "rma_p", "physics"),
    "paper": ("safedpa", "rma", "rma_p", "ppo"),
}
"""Driven when no method is named, by family."""
_COMPARED: Final = ("safe", "both")
"""Measures in which SafeDPA is compared with each other method."""


@final
@dataclass(frozen=True)
class CarCurves(CarRun):
    """The parameters of a run. Raises InputError for an invalid one."""

    sweeps: tuple[str, ...] = tuple(SWEEPS)
    first_seed: int = 1000
    """Of the scenes: those of ``experiment car`` are below."""

    def __post_init__(self) -> None:
        super().__post_init__()
        chosen_sweeps(self.sweeps)

    def drivable(self) -> tuple[list[Method], list[str]]:
        """The methods that it drives, and sentences about those left out. Raises InputError where it has none."""
        known = replace(FAMILIES[self.family], methods=METHODS_OF[self.family])
        return drivable_methods(self.methods, self.models, known)


def car_curves(curves: CarCurves, report_progress: ReportProgress = silent) -> dict[str, Any]:
    """Runs it; the progress counts episodes and recorded drives. The same curves give the same figures.

    In each sweep: a point for each value and method, and SafeDPA against each other method at each value, with Holm's
    correction over all comparisons of the sweep.
    """
    methods, missing = curves.drivable()
    sweeps, settings = chosen_sweeps(curves.sweeps), FAMILIES[curves.family].settings("car")
    calibration = curves.calibration(methods, settings, tuple(CONFIGURATIONS))
    places = list(dict.fromkeys(sweep.at(value) for sweep in sweeps for value in sweep.values))
    advance = Progress(calibration.size + len(places) * len(methods) * curves.episodes, report_progress).advance
    seeds = tuple(range(curves.first_seed, curves.first_seed + curves.episodes))
    with Workers(curves.processes) as workers:
        margins, reported = calibration.margins(workers, advance)
        cells = [
            Cell(method, at.load, seeds, curves.models, settings, margins.get(method.filter_model or ""), at.conditions)
            for at in places
            for method in methods
        ]
        found: dict[Place, dict[str, list[Outcome]]] = {place: {} for place in places}
        for cell, outcomes in run_cells(cells, workers, curves.out, advance):
            found[Place(cell.load, cell.conditions)][cell.method.name] = outcomes
    return {
        "experiment": "car-curves",
        **curves.head(methods, missing),
        "load": LOAD,
        "margin": reported,
        "sweeps": {sweep.name: _along(sweep, methods, found) for sweep in sweeps},
    }


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


def run(options: Options, report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment car-curves``."""
    models = options["models"] or family_named(options["family"]).models
    curves = with_options(CarCurves, options, models=models, date=time.strftime("%Y-%m-%d"))
    return car_curves(curves, report_progress)
