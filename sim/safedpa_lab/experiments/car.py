"""The paper's car experiment: every method in every configuration, prediction errors, latents, margins.

Reality is the pymunk car, which no model was trained on. Each episode runs the real nodes of adaptation, policy and
safety filter in lockstep.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from safedpa.dynamics import PhysicsModel
from safedpa.errors import InputError, did_you_mean
from safedpa.safety import FilterSettings
from safedpa.safety.calibration import MarginCalibration
from safedpa_lab.experiments.car_cells import Cell, run_cells
from safedpa_lab.experiments.car_drives import Drive, DriveOrder, cut_at_contact, recorded_drive
from safedpa_lab.experiments.car_errors import error_ratios, errors_of_model, increment_scale
from safedpa_lab.experiments.car_family import FAMILIES, family_named
from safedpa_lab.experiments.car_latent import latent_result
from safedpa_lab.experiments.car_margin import COVERAGE, coverage_of, margin_of, step_errors
from safedpa_lab.experiments.car_methods import chosen_methods, model_path, named_model
from safedpa_lab.experiments.car_orders import (
    EARNEST,
    FIRST_SEEDS,
    earnest_orders,
    hitching_orders,
    open_orders,
    path_orders,
)
from safedpa_lab.experiments.car_paths import FIRST_STEPS, PREDICTED_STEPS, predicted_paths
from safedpa_lab.experiments.car_scenes import CONFIGURATIONS
from safedpa_lab.experiments.car_table import cell_of
from safedpa_lab.experiments.car_workers import Workers

__all__ = ["PARTS", "CarExperiment", "car_experiment"]

PARTS = ("table", "errors", "latent")
"""What can be asked for by itself."""

_PREDICTORS = ("car_learned", "car_simulated", "car_fix", "car_mix", "car")
"""Models whose predictions are measured, where they exist."""

Values = NDArray[np.float64]
Tell = Callable[[int, int], None]


@dataclass(frozen=True)
class CarExperiment:
    """What to run. Raises InputError naming what does not fit."""

    models: Path
    """Folder of the learned models; what is not in it is looked for among those that ship, if the family does."""
    out: Path | None = None
    """Where cells are kept, so that a run that was broken off goes on."""
    episodes: int = 100
    first_seed: int = 0
    methods: tuple[str, ...] = ()
    """All that can be driven, when empty."""
    loads: tuple[str, ...] = tuple(CONFIGURATIONS)
    parts: tuple[str, ...] = PARTS
    margin: str | float = "conformal"
    """Of every filter: each model's own ``conformal`` or ``theorem`` epsilon, or this number for all."""
    settings: str = "car"
    family: str = "best"
    """In which world the policies were trained; see ``car_family``."""
    processes: int = 2
    drives: int = 6
    """Recorded drives of each kind and configuration."""
    drive_ticks: int = 400
    date: str = ""

    def __post_init__(self) -> None:
        family_named(self.family)
        for name in ("episodes", "processes", "drives"):
            if getattr(self, name) < 1:
                raise InputError(f"{name}: got {getattr(self, name)}, wanted at least 1")
        if not 0 <= self.first_seed <= FIRST_SEEDS["margin"] - self.episodes:
            raise InputError(
                f"first seed: got {self.first_seed} with {self.episodes} episodes, wanted seeds from 0 and below "
                f"{FIRST_SEEDS['margin']}, where those of the recorded drives begin"
            )
        if self.drive_ticks < 120:
            raise InputError(f"drive ticks: got {self.drive_ticks}, wanted at least 120: a history and one second")
        for names, known in ((self.loads, CONFIGURATIONS), (self.parts, PARTS)):
            for name in names:
                if name not in known:
                    raise InputError(f"'{name}': {did_you_mean(name, known)}")


def car_experiment(experiment: CarExperiment, tell: Tell = lambda _done, _all: None) -> dict[str, Any]:
    """Runs it. ``tell(done, all)`` counts episodes and recorded drives. The same experiment gives the same figures."""
    return _Run(experiment, tell).result()


class _Run:
    def __init__(self, experiment: CarExperiment, tell: Tell) -> None:
        self._experiment = experiment
        self._family = FAMILIES[experiment.family]
        self._settings = replace(self._family.settings(experiment.settings), margin=experiment.margin)
        self._methods, self._missing = chosen_methods(experiment.methods, experiment.models, self._family)
        if not self._methods:
            raise InputError(f"{experiment.models}: none of the methods can be driven; {self._missing[0]}")
        self._tell, self._done = tell, 0
        self._all = self._work()

    def result(self) -> dict[str, Any]:
        experiment = self._experiment
        result: dict[str, Any] = {
            "experiment": "car",
            "family": {"name": self._family.name, "words": self._family.words},
            "seeds": [experiment.first_seed, experiment.first_seed + experiment.episodes - 1],
            "left_out": self._missing,
            "methods": {item.name: {"title": item.title, "meaning": item.meaning} for item in self._methods},
        }
        with Workers(experiment.processes) as workers:
            if "table" in experiment.parts:
                margins, result["margin"] = self._margins(workers)
                result["cells"] = list(self._cells(workers, margins))
            if {"errors", "latent"} & set(experiment.parts):
                result.update(self._measured(workers))
        return result

    def _margins(self, workers: Workers) -> tuple[dict[str, MarginCalibration], dict[str, Any]]:
        experiment = self._experiment
        drivers = self._drivers()
        models = [named_model(name, experiment.models) for name in drivers]
        uncalibrated = replace(self._settings, margin="conformal")
        loads, each = self._family.calibrating(experiment.loads, experiment.drives)
        work = []
        for name, method in drivers.items():
            known, fresh = (
                self._recorded(workers, earnest_orders(loads, each, purpose, method, experiment.models, uncalibrated))
                for purpose in ("margin", "fresh")
            )
            scale = increment_scale(models, known)
            work.append(_MarginWork(name, experiment, self._settings, scale, known, fresh))
        margins, rows = {}, {}
        for name, (margin, coverage) in zip(drivers, workers.map(_margin, work), strict=True):
            margins[name], rows[name] = margin, coverage
        told = {"used": experiment.margin, "coverage_wanted": COVERAGE, "calibrated_with": list(loads)}
        return margins, {**told, "models": rows}

    def _drivers(self) -> dict[str, str]:
        """By filter model: the method that drives for its margin, the first one that has it."""
        drivers: dict[str, str] = {}
        for method in self._methods:
            if method.filter_model:
                drivers.setdefault(method.filter_model, method.name)
        return drivers

    def _cells(self, workers: Workers, margins: dict[str, MarginCalibration]) -> Iterator[dict[str, Any]]:
        experiment = self._experiment
        seeds = tuple(range(experiment.first_seed, experiment.first_seed + experiment.episodes))
        cells = [
            Cell(method, load, seeds, experiment.models, self._settings, margins.get(method.filter_model or ""))
            for method in self._methods
            for load in experiment.loads
        ]
        for cell, outcomes in run_cells(cells, workers, experiment.out, self._advance):
            yield cell_of(cell.method, cell.load, outcomes)

    def _measured(self, workers: Workers) -> dict[str, Any]:
        experiment = self._experiment
        each, ticks = experiment.drives, experiment.drive_ticks
        models = {
            name: named_model(name, experiment.models)
            for name in _PREDICTORS
            if model_path(name, experiment.models, ships=self._family.ships) is not None
            and not self._family.refuses(named_model(name, experiment.models).base)
        }
        heldout = self._recorded(workers, open_orders(experiment.loads, each, ticks, "errors"))
        scale = increment_scale(list(models.values()), heldout)
        result: dict[str, Any] = {"increment_scale": scale.tolist()}
        if "errors" in experiment.parts:
            errors = {name: errors_of_model(model, heldout, scale) for name, model in models.items()}
            shown = self._recorded(workers, path_orders(experiment.loads, FIRST_STEPS + PREDICTED_STEPS))
            result.update(errors=errors, ratios=_ratios(errors), paths=predicted_paths(models, shown))
        if "latent" in experiment.parts:
            fitting = self._recorded(workers, open_orders(experiment.loads, each, ticks, "latent"))
            hitching = self._recorded(workers, hitching_orders(experiment.loads, each, ticks))
            result["latent"] = {
                name: latent_result(model, fitting, heldout, hitching, scale)
                for name, model in models.items()
                if model.latent_names
            }
        return result

    def _recorded(self, workers: Workers, orders: Sequence[DriveOrder]) -> list[Drive]:
        drives = []
        for drive in workers.map(recorded_drive, orders):
            drives.append(cut_at_contact(drive))
            self._advance(1)
        return drives

    def _advance(self, count: int) -> None:
        self._done += count
        self._tell(self._done, self._all)

    def _work(self) -> int:
        experiment = self._experiment
        a_kind = experiment.drives * len(experiment.loads)
        towing = experiment.drives * sum(load != "none" for load in experiment.loads)
        episodes = len(self._methods) * len(experiment.loads) * experiment.episodes
        parts = {
            "table": 2 * EARNEST * len(self._drivers()) * a_kind + episodes,
            "errors": a_kind + len(experiment.loads),
            "latent": a_kind + towing,
        }
        both = a_kind if set(experiment.parts) == {"latent"} else 0
        return sum(parts[part] for part in experiment.parts) + both


@dataclass(frozen=True)
class _MarginWork:
    name: str
    experiment: CarExperiment
    settings: FilterSettings
    scale: Values
    known: list[Drive]
    fresh: list[Drive]


def _margin(work: _MarginWork) -> tuple[MarginCalibration, dict[str, Any]]:
    """The margin of one model, and what it covers on fresh drives."""
    model: PhysicsModel = named_model(work.name, work.experiment.models)
    margin = margin_of(model, step_errors(model, work.known, work.settings, work.scale), work.experiment.date)
    return margin, coverage_of(margin, step_errors(model, work.fresh, work.settings, work.scale))


def _ratios(errors: dict[str, Any]) -> dict[str, Any] | None:
    """Untuned over tuned, where there are both."""
    if not {"car_simulated", "car_learned"} <= set(errors):
        return None
    return error_ratios(errors, "car_simulated", "car_learned")
