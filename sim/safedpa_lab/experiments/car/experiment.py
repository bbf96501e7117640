"""The paper's car experiment: every method in every configuration, prediction errors, latents, margins.

The true system is the pymunk car, which no model was trained on. Each episode runs the real nodes of adaptation,
policy and safety filter in lockstep.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from safedpa.errors import InputError, did_you_mean
from safedpa.safety import FilterSettings
from safedpa.safety.margins.calibration import MarginCalibration
from safedpa_lab.experiments.car.conditions import CONFIGURATIONS
from safedpa_lab.experiments.car.drives import check_episode_seeds, hitching_orders, open_orders, path_orders
from safedpa_lab.experiments.car.episodes import Cell, Outcome, run_cells
from safedpa_lab.experiments.car.latent import latent_result
from safedpa_lab.experiments.car.margin import Calibration, recorded, with_margins_of
from safedpa_lab.experiments.car.methods import (
    FAMILIES,
    METHODS,
    Method,
    drivable_methods,
    family_named,
    model_path,
    named_model,
)
from safedpa_lab.experiments.car.predictor import (
    FIRST_STEPS,
    PREDICTED_STEPS,
    error_ratios,
    errors_of_model,
    increment_scale,
    predicted_paths,
)
from safedpa_lab.experiments.car.report import OWN, advantages, cell_of
from safedpa_lab.experiments.common.workers import Progress, Workers
from safedpa_lab.experiments.record import Options, ReportProgress, Result, silent, with_options

PARTS = ("table", "errors", "latent", "equal-margin")
"""Parts that can be run alone."""
_PREDICTORS = ("car_learned", "car_simulated", "car_fix", "car_mix", "car")
"""Models whose predictions are measured, where they exist."""


@dataclass(frozen=True)
class CarRun:
    """The parameters that the experiments on the car share. Raises InputError for an invalid one."""

    models: Path
    """Folder of the learned models; missing ones are taken from the shipped models, if the family allows it."""
    out: Path | None = None
    """Folder of finished episodes, so that an interrupted run continues."""
    family: str = "best"
    """In which world the policies were trained."""
    methods: tuple[str, ...] = ()
    """All that can be driven, when empty."""
    episodes: int = 100
    first_seed: int = 0
    processes: int = 2
    drives: int = 6
    """Recorded drives of each kind and configuration."""
    date: str = ""

    def __post_init__(self) -> None:
        family_named(self.family)
        for name in ("episodes", "equal_margin_episodes", "processes", "drives"):
            if getattr(self, name, 1) < 1:
                raise InputError(f"{name.replace('_', ' ')}: got {getattr(self, name)}, wanted at least 1")
        check_episode_seeds(self.first_seed, self.episodes)

    def head(self, methods: Sequence[Method], missing: Sequence[str]) -> dict[str, Any]:
        """What a result says of its parameters."""
        family = FAMILIES[self.family]
        return {
            "family": {"name": family.name, "phrase": family.phrase},
            "seeds": [self.first_seed, self.first_seed + self.episodes - 1],
            "left_out": missing,
            "methods": {item.name: {"title": item.title, "meaning": item.meaning} for item in methods},
        }

    def calibration(self, methods: Sequence[Method], settings: FilterSettings, loads: tuple[str, ...]) -> Calibration:
        """What the margins of the methods rest on."""
        family = FAMILIES[self.family]
        return Calibration(tuple(methods), self.models, family, settings, loads, self.drives, self.date)


@dataclass(frozen=True)
class CarExperiment(CarRun):
    """The parameters of a run. Raises InputError for an invalid one."""

    equal_margin_episodes: int = 50
    """Of the table in which all filters have SafeDPA's margin; never more than ``episodes``."""
    loads: tuple[str, ...] = tuple(CONFIGURATIONS)
    parts: tuple[str, ...] = PARTS
    margin: str | float = "conformal"
    """Of every filter: each model's own ``conformal`` or ``theorem`` epsilon, or this number for all."""
    settings: str = "car"
    drive_ticks: int = 400

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.drive_ticks < 120:
            raise InputError(f"drive ticks: got {self.drive_ticks}, wanted at least 120: a history and one second")
        for names, known in ((self.loads, CONFIGURATIONS), (self.parts, PARTS)):
            for name in names:
                if name not in known:
                    raise InputError(f"'{name}': {did_you_mean(name, known)}")

    @property
    def filter_settings(self) -> FilterSettings:
        """Of every filter. Raises InputError naming what is wrong with them."""
        return replace(family_named(self.family).settings(self.settings), margin=self.margin)

    def drivable(self) -> tuple[list[Method], list[str]]:
        """The methods that it drives, and sentences about those left out. Raises InputError where it has none, or
        where nothing is asked for but SafeDPA's margin for all and SafeDPA is not among them."""
        present, missing = drivable_methods(self.methods, self.models, FAMILIES[self.family])
        if set(self.parts) == {"equal-margin"} and OWN not in {method.name for method in present}:
            raise InputError(
                f"part equal-margin: got no '{OWN}' among the methods, whose margin all shall have; "
                f"{missing[0] if missing else 'name it as well'}"
            )
        return present, missing


def car_experiment(experiment: CarExperiment, report_progress: ReportProgress = silent) -> dict[str, Any]:
    """Runs it; the progress counts episodes and recorded drives. The same experiment gives the same figures."""
    return _Run(experiment, report_progress).result()


class _Run:
    def __init__(self, experiment: CarExperiment, report_progress: ReportProgress) -> None:
        self._experiment, self._settings = experiment, experiment.filter_settings
        self._methods, self._missing = experiment.drivable()
        self._calibration = experiment.calibration(self._methods, self._settings, experiment.loads)
        self._equal = [method for method in self._methods if method.filter_model]
        if METHODS[OWN] not in self._equal or "equal-margin" not in experiment.parts:
            self._equal = []
        self._equal_episodes = min(experiment.equal_margin_episodes, experiment.episodes)
        self._advance = Progress(self._work(), report_progress).advance

    def result(self) -> dict[str, Any]:
        experiment = self._experiment
        result = {"experiment": "car", **experiment.head(self._methods, self._missing)}
        with Workers(experiment.processes) as workers:
            if "table" in experiment.parts or self._equal:
                margins, result["margin"] = self._calibration.margins(workers, self._advance)
                result |= self._tables(workers, margins)
            if {"errors", "latent"} & set(experiment.parts):
                result |= self._measured(workers)
        return result

    def _tables(self, workers: Workers, margins: dict[str, MarginCalibration]) -> dict[str, Any]:
        """With each filter's own margin, and with SafeDPA's for all."""
        experiment, tables = self._experiment, {}
        if "table" in experiment.parts:
            cells = self._cells(self._methods, experiment.episodes, margins, self._settings)
            tables = self._table(cells, workers, experiment.out)
        if self._equal:
            model = METHODS[OWN].filter_model
            assert model is not None
            settings = replace(self._settings, margin="conformal")
            cells = self._cells(self._equal, self._equal_episodes, with_margins_of(model, margins), settings)
            place = None if experiment.out is None else experiment.out / "equal-margin"
            tables["equal_margin"] = {"epsilon": margins[model].epsilon, **self._table(cells, workers, place)}
        return tables

    def _cells(
        self, methods: Sequence[Method], episodes: int, margins: dict[str, MarginCalibration], settings: FilterSettings
    ) -> list[Cell]:
        experiment = self._experiment
        seeds = tuple(range(experiment.first_seed, experiment.first_seed + episodes))
        return [
            Cell(method, load, seeds, experiment.models, settings, margins.get(method.filter_model or ""))
            for method in methods
            for load in experiment.loads
        ]

    def _table(self, cells: Sequence[Cell], workers: Workers, out: Path | None) -> dict[str, Any]:
        """The cells, and SafeDPA against each other method: over all configurations, and in each."""
        driven = list(run_cells(cells, workers, out, self._advance))
        places: dict[str, dict[str, list[Outcome]]] = {}
        for cell, outcomes in driven:
            for place in ("all", cell.load) if len(self._experiment.loads) > 1 else (cell.load,):
                places.setdefault(place, {}).setdefault(cell.method.name, []).extend(outcomes)
        shown = [cell_of(cell.method, cell.load, outcomes) for cell, outcomes in driven]
        return {"cells": shown, "advantages": advantages(places)}

    def _measured(self, workers: Workers) -> dict[str, Any]:
        experiment, family = self._experiment, FAMILIES[self._experiment.family]
        each, ticks, loads = experiment.drives, experiment.drive_ticks, experiment.loads
        models = {
            name: named_model(name, experiment.models)
            for name in _PREDICTORS
            if model_path(name, experiment.models, ships=family.ships) is not None
            and not family.refuses(named_model(name, experiment.models).base)
        }
        heldout = recorded(workers, open_orders(loads, each, ticks, "errors"), self._advance)
        scale = increment_scale(list(models.values()), heldout)
        result: dict[str, Any] = {"increment_scale": scale.tolist()}
        if "errors" in experiment.parts:
            errors = {name: errors_of_model(model, heldout, scale) for name, model in models.items()}
            both = {"car_simulated", "car_learned"} <= set(errors)
            ratios = error_ratios(errors, "car_simulated", "car_learned") if both else None
            shown = recorded(workers, path_orders(loads, FIRST_STEPS + PREDICTED_STEPS), self._advance)
            result.update(errors=errors, ratios=ratios, paths=predicted_paths(models, shown))
        if "latent" in experiment.parts:
            fitting = recorded(workers, open_orders(loads, each, ticks, "latent"), self._advance)
            hitching = recorded(workers, hitching_orders(loads, each, ticks), self._advance)
            result["latent"] = {
                name: latent_result(model, fitting, heldout, hitching, scale)
                for name, model in models.items()
                if model.latent_names
            }
        return result

    def _work(self) -> int:
        experiment = self._experiment
        a_kind = experiment.drives * len(experiment.loads)
        towing = experiment.drives * sum(load != "none" for load in experiment.loads)
        calibrated = self._calibration.size if "table" in experiment.parts or self._equal else 0
        parts = {
            "table": len(self._methods) * len(experiment.loads) * experiment.episodes,
            "equal-margin": len(self._equal) * len(experiment.loads) * self._equal_episodes,
            "errors": a_kind + len(experiment.loads),
            "latent": a_kind + towing,
        }
        both = a_kind if set(experiment.parts) == {"latent"} else 0
        return calibrated + sum(parts[part] for part in experiment.parts) + both


def run(options: Options, report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment car``."""
    models = options["models"] or family_named(options["family"]).models
    known = {"models": models, "margin": _margin(options["margin"]), "date": time.strftime("%Y-%m-%d")}
    return car_experiment(with_options(CarExperiment, options, **known), report_progress)


def _margin(text: str) -> str | float:
    if text in ("conformal", "theorem"):
        return text
    try:
        return float(text)
    except ValueError as error:
        raise InputError(f"--margin: got '{text}', wanted 'conformal', 'theorem' or a number in m") from error
