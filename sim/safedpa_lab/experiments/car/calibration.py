"""The margins of the filters that an experiment on the car drives: each model's own, by one rule, on like drives."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, final

from safedpa.arrays import FloatArray
from safedpa.dynamics import PhysicsModel
from safedpa.safety import FilterSettings
from safedpa.safety.margins.calibration import MarginCalibration
from safedpa_lab.experiments.car.drives import (
    EARNEST,
    Drive,
    DriveOrder,
    cut_at_contact,
    earnest_orders,
    recorded_drive,
)
from safedpa_lab.experiments.car.errors import increment_scale
from safedpa_lab.experiments.car.family import Family
from safedpa_lab.experiments.car.margin import COVERAGE, coverage_of, margin_of, step_errors
from safedpa_lab.experiments.car.methods import Method, named_model
from safedpa_lab.experiments.common.workers import Workers

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
            work.append(_Work(name, self, increment_scale(models, known), known, fresh))
        margins, rows = {}, {}
        for name, (margin, coverage) in zip(self.drivers, workers.map(_margin, work), strict=True):
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


@dataclass(frozen=True)
class _Work:
    name: str
    calibration: Calibration
    scale: FloatArray
    known: list[Drive]
    fresh: list[Drive]


def _margin(work: _Work) -> tuple[MarginCalibration, dict[str, Any]]:
    """The margin of one model, and what it covers on fresh drives."""
    model: PhysicsModel = named_model(work.name, work.calibration.models)
    settings = work.calibration.settings
    margin = margin_of(model, step_errors(model, work.known, settings, work.scale), work.calibration.date)
    return margin, coverage_of(margin, step_errors(model, work.fresh, settings, work.scale))
