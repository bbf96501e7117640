"""Margins of the filters of the car experiment: one rule for all models, on like drives, and their coverage.

The rule: epsilon of each kind of barrier is the split conformal quantile of the model's own one-step error of h, at
99 %, on the same recorded drives for every model. A model that predicts worse pays with a wider margin. Next to it
stands the bound by norms that the theory allows on a robot (the docs page on theory): the same quantile of

    |p|_1 |v - v^|_sup >= |h(x + v) - h(x + v^)|,

v, v^ the true and the predicted change in the car's own frame over the scale of the networks, |p|_1 the barrier's
largest gradient.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.bus import StateMessage
from safedpa.dynamics import PhysicsModel, fingerprint
from safedpa.errors import InputError
from safedpa.networks import frame_of
from safedpa.robots.car.barriers.obstacles import largest_gradients
from safedpa.robots.car.scenes.perceived import CarScene
from safedpa.safety import FilterSettings
from safedpa.safety.barriers.base import AbstractBarrier
from safedpa.safety.margins.calibration import MarginCalibration
from safedpa.safety.margins.conformal import smallest_sample, split_conformal_margin
from safedpa_lab.experiments.car.drives import (
    EARNEST,
    Drive,
    DriveOrder,
    cut_at_contact,
    earnest_orders,
    recorded_drive,
)
from safedpa_lab.experiments.car.methods import Family, Method, named_model
from safedpa_lab.experiments.car.predictor import increment_scale, latents_along
from safedpa_lab.experiments.common.statistics import wilson_interval
from safedpa_lab.experiments.common.workers import Workers

COVERAGE = 0.99
"""Share of steps that a margin covers, for each kind of barrier."""


@dataclass(frozen=True)
class StepErrors:
    """Errors of a model's one-step predictions along recorded drives, by kind of barrier, each (steps,)."""

    h: dict[str, FloatArray]
    """The worst h(predicted next state) - h(measured next state) over the kind's barriers."""
    bound: dict[str, FloatArray]
    """What the theory's bound makes of the error of the state in the same steps; never below ``h``."""


def step_errors(
    model: PhysicsModel, drives: Sequence[Drive], settings: FilterSettings, scale: FloatArray
) -> StepErrors:
    """Along the drives, with the adaptation's latent at each tick and the actuators' memory carried along.

    ``scale`` (states,) of the state's change in the car's own frame.
    """
    h: dict[str, list[float]] = {}
    bound: dict[str, list[float]] = {}
    for drive in drives:
        scene = CarScene(settings)
        gradients = largest_gradients(settings, drive.messages[0].footprint, scale)
        for before, expected, measured in _steps(model, drive):
            size = _largest_entry(np.array(before.values), expected, measured, scale)
            for kind, error in worst_errors(_barriers(scene, before), expected, measured).items():
                h.setdefault(kind, []).append(error)
                bound.setdefault(kind, []).append(gradients[kind] * size)
    return StepErrors(*({kind: np.array(values) for kind, values in found.items()} for found in (h, bound)))


def _steps(model: PhysicsModel, drive: Drive) -> Iterator[tuple[StateMessage, FloatArray, FloatArray]]:
    """State message, predicted and measured next state (states,) of every step."""
    latents = latents_along(model, drive)
    memory: Any = model.initial_memory(np.array(drive.messages[0].applied))
    for before, after, latent in zip(drive.messages, drive.messages[1:], latents, strict=False):
        state, action = np.array(before.values), np.array(after.applied)
        expected, memory = model.advance(state, action, memory, latent, period=before.period)
        yield before, expected, np.array(after.values)


def _largest_entry(state: FloatArray, expected: FloatArray, measured: FloatArray, scale: FloatArray) -> float:
    """|v - v^|_sup."""
    frame = frame_of("car")
    difference = frame.own_increment(state, measured) - frame.own_increment(state, expected)
    return float(np.abs(difference / scale).max())


def worst_errors(barriers: Sequence[AbstractBarrier], expected: FloatArray, measured: FloatArray) -> dict[str, float]:
    """By kind: max over its barriers of h(expected) - h(measured); positive where the model hoped too much."""
    errors: dict[str, float] = {}
    for part in barriers:
        worst = float((part.h(expected) - part.h(measured)).max(initial=-np.inf))
        errors[part.kind] = max(errors.get(part.kind, -np.inf), worst)
    return {kind: error for kind, error in errors.items() if np.isfinite(error)}


def margin_of(model: PhysicsModel, errors: StepErrors, date: str) -> MarginCalibration:
    """The margins that cover 99 % of the steps. Raises InputError when there are too few of them."""
    count = min((len(values) for values in errors.h.values()), default=0)
    if count < smallest_sample(COVERAGE):
        raise InputError(f"margin: got {count} steps, wanted at least {smallest_sample(COVERAGE)}; drive longer")
    epsilon = {kind: max(0.0, split_conformal_margin(values, COVERAGE)) for kind, values in errors.h.items()}
    theorem = {kind: split_conformal_margin(values, COVERAGE) for kind, values in errors.bound.items()}
    return MarginCalibration(epsilon, COVERAGE, count, date, fingerprint(model), theorem, period=model.period)


def coverage_of(margin: MarginCalibration, fresh: StepErrors) -> dict[str, Any]:
    """By kind of barrier and of margin: epsilon, and how many fresh errors of h it covers, with a 95 % interval."""
    rows: dict[str, Any] = {}
    for kind, errors in fresh.h.items():
        rows[kind] = {"steps": len(errors), "largest_error": float(errors.max())}
        for name, epsilon in (("conformal", margin.epsilon[kind]), ("theorem", margin.theorem[kind])):
            covered = int((errors <= epsilon).sum())
            rows[kind][name] = {
                "epsilon": epsilon,
                "covered": covered,
                "share": covered / len(errors),
                "interval_95": list(wilson_interval(covered, len(errors))),
            }
    return rows


@final
class CoverageCount:
    """Counts along one episode how often the margin that the settings name covered what the filter predicted."""

    def __init__(self, settings: FilterSettings, margin: MarginCalibration | None) -> None:
        self._scene = CarScene(settings)
        self._margin = None if margin is None else margin.select(settings.margin)
        self._expected: FloatArray | None = None
        self._barriers: Sequence[AbstractBarrier] = ()
        self.counts: dict[str, list[int]] = {}
        """By kind: steps covered, and all steps; empty without a margin."""

    def see(self, state: StateMessage, predicted: Sequence[Sequence[float]]) -> None:
        """One tick: the measured state, and the states that the filter expects after it."""
        if self._margin is None:
            return
        if self._expected is not None:
            errors = worst_errors(self._barriers, self._expected, np.array(state.values))
            for kind, error in errors.items():
                count = self.counts.setdefault(kind, [0, 0])
                count[0] += error <= self._margin.epsilon[kind]
                count[1] += 1
        self._barriers = _barriers(self._scene, state)
        self._expected = np.array(predicted[0]) if predicted else None


def _barriers(scene: CarScene, message: StateMessage) -> Sequence[AbstractBarrier]:
    barriers = scene.of(message)
    if isinstance(barriers, str):
        raise InputError(f"recorded drive, tick {message.tick}: {barriers}; record it again")
    return barriers


Margins = dict[str, MarginCalibration]
"""By name of the filter's model."""
_PURPOSES = ("margin", "fresh")
"""Drives that calibrate, and as many that count what was covered."""


@final
@dataclass(frozen=True)
class Calibration:
    """What the margins of an experiment rest on."""

    methods: tuple[Method, ...]
    models: Path
    family: Family
    settings: FilterSettings
    loads: tuple[str, ...]
    """Of the experiment; the family may calibrate with others."""
    drives: int
    """Recorded drives of each load, times ``EARNEST``."""
    date: str

    @property
    def drivers(self) -> dict[str, str]:
        """By filter model: the method that drives for its margin, the first one that has it."""
        drivers: dict[str, str] = {}
        for method in self.methods:
            if method.filter_model:
                drivers.setdefault(method.filter_model, method.name)
        return drivers

    @property
    def size(self) -> int:
        """How many drives are recorded."""
        loads, each = self.family.calibrating(self.loads, self.drives)
        return len(_PURPOSES) * EARNEST * len(self.drivers) * len(loads) * each

    def margins(self, workers: Workers, advance: Callable[[int], None]) -> tuple[Margins, dict[str, Any]]:
        """The margins, and what they cover on fresh drives, for the result; ``advance`` counts recorded drives."""
        models = [named_model(name, self.models) for name in self.drivers]
        uncalibrated = replace(self.settings, margin="conformal")
        loads, each = self.family.calibrating(self.loads, self.drives)
        work = []
        for name, method in self.drivers.items():
            known, fresh = (
                recorded(workers, earnest_orders(loads, each, purpose, method, self.models, uncalibrated), advance)
                for purpose in _PURPOSES
            )
            work.append((name, increment_scale(models, known), known, fresh))
        margins, rows = {}, {}
        for name, (margin, coverage) in zip(self.drivers, workers.map(partial(_margin, self), work), strict=True):
            margins[name], rows[name] = margin, coverage
        reported = {"used": self.settings.margin, "coverage_wanted": COVERAGE, "calibrated_with": list(loads)}
        return margins, {**reported, "models": rows}


def recorded(workers: Workers, orders: Sequence[DriveOrder], advance: Callable[[int], None]) -> list[Drive]:
    """The drives, each up to its first contact; calls ``advance`` after each."""
    drives = []
    for drive in workers.map(recorded_drive, orders):
        drives.append(cut_at_contact(drive))
        advance(1)
    return drives


def with_margins_of(model: str, margins: Mapping[str, MarginCalibration]) -> Margins:
    """Every filter's calibration with the epsilon of one model, kind by kind: the same margin for all."""
    return {name: replace(margin, epsilon=dict(margins[model].epsilon)) for name, margin in margins.items()}


_Work = tuple[str, FloatArray, list[Drive], list[Drive]]
"""Model, scale of the errors, drives that calibrate, and fresh ones."""


def _margin(calibration: Calibration, work: _Work) -> tuple[MarginCalibration, dict[str, Any]]:
    """The margin of one model, and what it covers on fresh drives."""
    name, scale, known, fresh = work
    model, settings = named_model(name, calibration.models), calibration.settings
    margin = margin_of(model, step_errors(model, known, settings, scale), calibration.date)
    return margin, coverage_of(margin, step_errors(model, fresh, settings, scale))
