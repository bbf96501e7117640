"""The tuning of the car's networks, and its honest comparison: every model, metric and load on the same fresh drives.

Reality is the pymunk car. Models are tuned on circles without load, or online: on two minutes that the robot drives
with the very load, judged on other drives with it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from safedpa.arrays import FloatArray
from safedpa.errors import InputError, did_you_mean
from safedpa_lab.experiments.car_drives import DriveOrder, cut_at_contact, recorded_drive
from safedpa_lab.experiments.car_scenes import CONFIGURATIONS
from safedpa_lab.experiments.seeds import seeds_for
from safedpa_lab.experiments.tuning_errors import HORIZONS, errors_of_drive, metrics_of, ratios_of
from safedpa_lab.experiments.tuning_models import ROWS, TunedModels
from safedpa_lab.experiments.tuning_retained import Retained, key_of
from safedpa_lab.provenance.code import without_text
from safedpa_sim.training.online_tuning import OnlineTuning, tuned_online
from safedpa_sim.training.predictors import AbstractPredictor
from safedpa_sim.training.tuning_data import TuningDrive

__all__ = ["BASES", "DEVELOPMENT", "LOADS", "CarTuning", "car_tuning"]

LOADS: Final = ("none", *(load for load in CONFIGURATIONS if load != "none"))
BASES: Final = ("untuned", "untuned_point")
"""What every row is compared with."""
DEVELOPMENT: Final = ((40_000, 40_003), (41_000, 41_001), (1_050_000, 1_050_001), (2_050_000, 2_050_009))
"""First and last seeds of the drives on which the settings of online and residual tuning were chosen."""
_SKIP: Final = 60_000
"""Seeds of each purpose before those of this experiment."""
_A_SEED: Final = 100
_SEEDS: Final = 300
"""Seeds that can be asked for."""
_OWN: Final = 2
"""Drives with its load that a robot tunes itself on."""
_MEASURE: Final = without_text(Path(__file__).with_name("tuning_errors.py").read_text(encoding="utf-8"))
"""What errors are: part of the key under which they are kept."""


@dataclass(frozen=True)
class CarTuning:
    """What to measure. Raises InputError naming what does not fit."""

    models: Path
    out: Path | None = None
    """Folder in which models, drives and errors are kept, so that a run that was cut off goes on."""
    seed: int = 0
    drives: int = 10
    """Fresh drives with each load."""
    ticks: int = 400
    own_ticks: int = 1200
    """Of each of the two drives that a robot tunes itself on; a minute."""
    rows: tuple[str, ...] = tuple(ROWS)
    small: bool = False

    def __post_init__(self) -> None:
        if not 0 <= self.seed < _SEEDS:
            raise InputError(f"seed: got {self.seed}, wanted 0 to {_SEEDS - 1}")
        if not 2 <= self.drives <= _A_SEED:
            raise InputError(f"drives: got {self.drives}, wanted 2 to {_A_SEED}")
        if self.ticks < 100 or self.own_ticks < 320:
            raise InputError(f"ticks: got {self.ticks} and {self.own_ticks}, wanted at least 100 and, of its own, 320")
        for row in self.rows:
            if row not in ROWS:
                raise InputError(f"row '{row}': {did_you_mean(row, ROWS)}")


def car_tuning(experiment: CarTuning, report_progress: Callable[[str], None] = lambda _what: None) -> dict[str, Any]:
    """Metrics by row, load and horizon, and their ratios to both untuned rows. The same seed gives the same figures."""
    retained = Retained(None if experiment.out is None else experiment.out / "retained")
    models = TunedModels(experiment.models, retained, experiment.seed, experiment.small, report_progress)
    scale = models.untuned["increment_scale"].astype(np.float64)
    fresh = seeds_for("evaluation", experiment.drives, _SKIP + _A_SEED * experiment.seed)
    own = seeds_for("calibration", _OWN, _SKIP + _A_SEED * experiment.seed)
    run = _Run(experiment, models, retained, report_progress)
    names = tuple(dict.fromkeys((*BASES, *experiment.rows)))
    errors = {}
    for name in names:
        report_progress(ROWS[name])
        errors[name] = run.errors(name, fresh, own, torch.from_numpy(scale).float())
    return {
        "increment_scale": scale.tolist(),
        "seeds": {
            "fresh": [fresh[0], fresh[-1]],
            "own": [own[0], own[-1]],
            "development": [list(pair) for pair in DEVELOPMENT],
        },
        "drives": {"ticks": experiment.ticks, "own_ticks": experiment.own_ticks, "each": experiment.drives},
        "online": asdict(OnlineTuning()),
        "rows": {
            name: {
                "title": ROWS[name],
                "refused": models.refusal(name),
                **_figures(errors, name, scale),
                **_taken(errors[name]),
            }
            for name in names
        },
    }


@dataclass
class _Run:
    experiment: CarTuning
    models: TunedModels
    retained: Retained
    report_progress: Callable[[str], None]

    def errors(self, row: str, fresh: Sequence[int], own: Sequence[int], scale: torch.Tensor) -> dict[str, Any]:
        """By load: the errors of each fresh drive, and for a row tuned online what was taken."""
        found: dict[str, Any] = {}
        base = self._base(row)
        for load in LOADS:
            drives = [self._drive(seed, load, self.experiment.ticks) for seed in fresh]
            learned: list[TuningDrive] = []
            if row.startswith("online_"):
                learned = [self._drive(seed, load, self.experiment.own_ticks) for seed in own]
            key = key_of(__name__, _MEASURE, *_reported(base), *_digests([*drives, *learned]), row)
            found[load] = self.retained.table(f"{row}-{load}", key, partial(_measured, base, drives, learned, scale))
        return found

    def _base(self, row: str) -> AbstractPredictor:
        begun = {"online_untuned": "at_axle", "online_tuned": "tuned_point"}
        return self.models.predictor(begun.get(row, row.removeprefix("online_")))

    def _drive(self, seed: int, load: str, ticks: int) -> TuningDrive:
        def make() -> tuple[FloatArray, ...]:
            drive = cut_at_contact(recorded_drive(DriveOrder(seed, load, ticks)))
            return drive.states, drive.actions

        key = key_of("safedpa_lab.experiments.car_drives", seed, load, ticks)
        return TuningDrive(*self.retained.arrays(f"drive-{load}-{seed}", key, make))


def _measured(
    base: AbstractPredictor, drives: Sequence[TuningDrive], own: Sequence[TuningDrive], scale: torch.Tensor
) -> dict[str, Any]:
    """Errors of each drive by the base, or by what it becomes by tuning on the robot's own drives."""
    if not own:
        return {"drives": [errors_of_drive(base, drive) for drive in drives]}
    tuned, taken = tuned_online(base, own, scale)
    errors = [errors_of_drive(tuned, drive) for drive in drives]
    return {"drives": errors, "taken": {**asdict(taken), "refused": taken.refused}}


def _figures(errors: dict[str, Any], name: str, scale: FloatArray) -> dict[str, Any]:
    """Metrics and ratios by load and horizon; ``loads`` are the three loads together, ``mixed`` all."""
    groups = {**{load: (load,) for load in LOADS}, "loads": LOADS[1:], "mixed": LOADS}
    figures: dict[str, Any] = {"metrics": {}, "ratios": {}}
    for group, loads in groups.items():
        figures["metrics"][group], figures["ratios"][group] = {}, {}
        for horizon in HORIZONS:
            paired = {row: _paired(errors[row], loads, horizon) for row in (name, *BASES)}
            flat = [drive for group_ in paired[name] for drive in group_]
            figures["metrics"][group][horizon] = metrics_of(flat, scale)
            figures["ratios"][group][horizon] = {
                base: ratios_of(paired[base], paired[name], scale) for base in BASES if base != name
            }
    return figures


def _paired(errors: dict[str, Any], loads: Sequence[str], horizon: str) -> list[list[dict[str, Any]]]:
    """For each seed, its drives with the loads."""
    columns = [[drive[horizon] for drive in errors[load]["drives"]] for load in loads]
    return [list(drives) for drives in zip(*columns, strict=True)]


def _taken(errors: dict[str, Any]) -> dict[str, Any]:
    found = {load: row["taken"] for load, row in errors.items() if "taken" in row}
    return {"taken": found} if found else {}


def _reported(predictor: AbstractPredictor) -> list[str]:
    """Numbers of the networks, and what else shapes a prediction, as text."""
    parts = (*predictor.networks.state_dict().values(), *predictor.encoder.state_dict().values())
    point = getattr(predictor, "point", None)
    return [type(predictor).__name__, str(point), *_digests([tuple(part.numpy() for part in parts)])]


def _digests(groups: Sequence[tuple[NDArray[Any], ...]]) -> list[str]:
    from hashlib import sha256

    return [
        sha256(b"".join(np.ascontiguousarray(part).tobytes() for part in group)).hexdigest()[:16] for group in groups
    ]
