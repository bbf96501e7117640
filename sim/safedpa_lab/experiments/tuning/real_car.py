"""Tuning on the logs of a real car: every log, and another day, judged by models that never saw it.

The networks are trained from nothing in the nominal simulator of that car, on throttle and steer, and tuned on three
quarters of each of the other logs. The last quarter calibrates the margin: the conformal quantile at 99 % of the error
of the position. All rows are judged on the second half of the log that was left out. Online tuning has its first half.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
import torch

from safedpa.arrays import FloatArray
from safedpa.dynamics import load_model
from safedpa.errors import InputError
from safedpa.networks import Weights
from safedpa.safety.margins.conformal import split_conformal_margin
from safedpa_lab.experiments.car.predictor import STEPS
from safedpa_lab.experiments.diagnosis.real_logs_data import CAR, OTHER_DAY, mapped_runs, paths_of
from safedpa_lab.experiments.tuning.errors import HORIZONS, errors_of_drive, metrics_of
from safedpa_lab.experiments.tuning.models import Retained, key_of
from safedpa_lab.tuning.online import tuned_online
from safedpa_lab.tuning.paper import PaperTuning, sequence_of, tune_as_written
from safedpa_lab.tuning.predictors import AbstractPredictor, NetworkPredictor, open_loop_errors
from safedpa_sim.training.configuration import Configuration, load_configuration
from safedpa_sim.training.data.recorded_runs import TuningDrive, drives_of
from safedpa_sim.training.phases.phase_1a import train_affine
from safedpa_sim.training.phases.phase_2 import train_history_encoder
from safedpa_sim.training.phases.phase_3 import tune_on_drives

REAL_ROWS: Final = {
    "untuned": "untuned",
    "paper": "L_TUNE as written",
    "ours": "ours, on recorded data alone",
    "online": "ours, then tuned online on the first half of the log itself",
}
_COVERAGE: Final = 0.99
_FITTED: Final = 0.75
"""Of each log that is tuned on; the rest calibrates the margin."""
_ENVIRONMENT: Final = {
    "constant_force.ax": (-0.8, 0.8),
    "constant_force.ay": (-0.8, 0.8),
    "rolling_resistance.deceleration": (0.0, 2.0),
    "viscous_drag.coefficient": (0.0, 2.0),
}
_FIRST: Final = 60
_LONG: Final = 2 * (_FIRST + STEPS) + 2
"""Shortest stretch, in rows, whose halves can still be evaluated."""


@dataclass(frozen=True)
class RealTuning:
    """What to measure; without a folder of ``data`` the part is left out.

    Raises InputError for a folder that does not hold two of the logs.
    """

    data: Path | None
    out: Path | None = None
    seed: int = 0
    small: bool = False

    def __post_init__(self) -> None:
        if self.data is not None and len(found := paths_of(self.data, CAR)) < 2:
            raise InputError(f"--data {self.data}: got {len(found)} logs of the real car, wanted two or more {CAR}")


def real_tuning(experiment: RealTuning, report_progress: Callable[[str], None] = lambda _what: None) -> dict[str, Any]:
    """Errors, margins and coverage by log left out, or a sentence why there are none.

    Raises InputError for logs that are too short or do not fit; the message names the log.
    """
    if experiment.data is None:
        return {"left_out": f"logs of the real car: no --data was given; wanted two or more files {CAR}"}
    logs = paths_of(experiment.data, CAR)
    retained = Retained(None if experiment.out is None else experiment.out / "retained")
    configuration = _configuration(experiment)
    untuned = _untuned(configuration, retained, report_progress)
    own, other = _logs(logs), _logs(paths_of(experiment.data, OTHER_DAY))
    drives_of(mapped_runs(logs, load_model("dart_car"), "dart_car_columns"), untuned)  # refuses what cannot be learned
    rows = []
    for name in own:
        rest = {key: drives for key, drives in own.items() if key != name}
        report_progress(f"real car, without {name}")
        rows.append(_fold(name, own[name], list(rest.values()), untuned, configuration, retained))
    if other:
        report_progress("real car, another day")
        drives = [drive for log in other.values() for drive in log]
        fold = _fold(min(other)[:10], drives, list(own.values()), untuned, configuration, retained)
        rows.append({**fold, "other_day": True})
    return {"coverage": _COVERAGE, "titles": REAL_ROWS, "folds": rows}


def parts_of(drives: Sequence[TuningDrive], share: float) -> tuple[list[TuningDrive], list[TuningDrive]]:
    """The beginning of each drive, that share of it, and the rest."""
    cuts = [round(share * len(drive.actions)) for drive in drives]
    return (
        [TuningDrive(drive.states[: cut + 1], drive.actions[:cut]) for drive, cut in zip(drives, cuts, strict=True)],
        [TuningDrive(drive.states[cut:], drive.actions[cut:]) for drive, cut in zip(drives, cuts, strict=True)],
    )


def _fold(
    name: str,
    left_out: list[TuningDrive],
    others: list[list[TuningDrive]],
    untuned: Weights,
    configuration: Configuration,
    retained: Retained,
) -> dict[str, Any]:
    """Every row on the second half of one log, tuned and calibrated on the others."""
    fitted, calibrated = parts_of([drive for drives in others for drive in drives], _FITTED)
    own, judged = parts_of(left_out, 0.5)
    scale = untuned["increment_scale"].astype(np.float64)
    key = key_of(__name__, untuned.digest, configuration.phase_3, *(len(drive.actions) for drive in fitted), name)

    def make() -> dict[str, Any]:
        models, notice = _models(untuned, configuration, fitted, own, torch.from_numpy(scale).float())
        return {
            "rows": {row: _judged(model, calibrated, judged, scale) for row, model in models.items()},
            "notice": notice,
        }

    return {
        "log": name,
        "transitions": sum(len(drive.actions) for drive in judged),
        **retained.table("real", key, make),
    }


def _models(
    untuned: Weights,
    configuration: Configuration,
    fitted: list[TuningDrive],
    own: list[TuningDrive],
    scale: torch.Tensor,
) -> tuple[dict[str, AbstractPredictor], dict[str, str]]:
    """The model of each row, and why one was not taken."""
    updates, notice = configuration.phase_3.updates, {}
    paper = tune_as_written(untuned, fitted, PaperTuning(updates, 512, seed=configuration.seed))
    try:
        ours, _ = tune_on_drives(configuration, untuned, fitted)
    except InputError as error:
        ours, notice["ours"] = untuned, f"refused: {error}"
    models = {"untuned": untuned, "paper": paper, "ours": ours}
    found: dict[str, AbstractPredictor] = {name: NetworkPredictor(weights) for name, weights in models.items()}
    try:
        found["online"], taken = tuned_online(found["ours"], own, scale)
        notice["online"] = "refused" if taken.refused else f"ridge {taken.ridge:g}"
    except InputError as error:
        notice["online"] = f"refused: {error}"
    return found, notice


def _judged(
    predictor: AbstractPredictor, calibrated: Sequence[TuningDrive], judged: Sequence[TuningDrive], scale: FloatArray
) -> dict[str, Any]:
    """Metrics by horizon, and the margin of the position [m] with its coverage."""
    errors = [errors_of_drive(predictor, drive) for drive in judged if _is_long(drive)]
    found: dict[str, Any] = {}
    for horizon, steps in zip(HORIZONS, (1, STEPS), strict=True):
        known, fresh = (
            np.concatenate([_position_errors(predictor, drive, steps) for drive in drives if _is_long(drive)])
            for drives in (calibrated, judged)
        )
        margin = split_conformal_margin(known, _COVERAGE)
        found[horizon] = {
            **metrics_of([error[horizon] for error in errors], scale),
            "margin": margin,
            "covered": float((fresh <= margin).mean()),
            "count": len(fresh),
        }
    return found


def _position_errors(predictor: AbstractPredictor, drive: TuningDrive, steps: int) -> FloatArray:
    """m from the measured to the predicted position after so many steps (starts,)."""
    seen = predictor.seen(sequence_of(predictor.networks, [drive]))
    starts = torch.arange(_FIRST, len(drive.actions) - steps + 1)
    with torch.no_grad():
        errors = open_loop_errors(predictor, seen, starts, steps)[-1]
    return np.asarray(torch.hypot(errors[:, 0], errors[:, 1]).double().numpy())


def _is_long(drive: TuningDrive) -> bool:
    return len(drive.actions) > _FIRST + STEPS


def _logs(paths: Sequence[Path]) -> dict[str, list[TuningDrive]]:
    """The stretches of each log without a gap, by the time in its name."""
    runs = mapped_runs(paths, load_model("dart_car"), "dart_car_columns")
    parts = {path.stem[-19:]: list(run.parts()) for path, run in zip(paths, runs, strict=True)}
    return {
        name: [TuningDrive(states, actions[:-1]) for _, states, actions in own if len(actions) > _LONG]
        for name, own in parts.items()
    }


def _configuration(experiment: RealTuning) -> Configuration:
    """The nominal throttle car: trained within minutes, tuned on recorded data alone."""
    car = load_configuration("car")
    small = experiment.small
    return replace(
        car,
        seed=experiment.seed,
        simulator=load_model("dart_car"),
        state={"speed": (-0.5, 5.0)},
        action={"throttle": (-0.3, 1.0), "steer": (-0.4, 0.4)},
        environment=_ENVIRONMENT,
        phase_1a=replace(car.phase_1a, pairs=20_000 if small else 1_500_000, hidden=96),
        phase_2=replace(
            car.phase_2, rounds=2, cars=60 if small else 400, steps=100, updates=10 if small else 250, batch=512
        ),
        phase_3=replace(car.phase_3, cars=0, updates=10 if small else 500, batch=512, rollouts=32),
    )


def _untuned(configuration: Configuration, retained: Retained, report_progress: Callable[[str], None]) -> Weights:
    def make() -> Weights:
        report_progress("real car: networks in its nominal simulator")
        with TemporaryDirectory() as folder:  # of checkpoints, which no one goes on from
            affine, _ = train_affine(configuration, Path(folder))
            return train_history_encoder(configuration, affine, Path(folder))[0]

    key = key_of(
        "safedpa_sim.training.phases.phase_2",
        configuration.seed,
        configuration.phase_1a,
        configuration.phase_2,
        _ENVIRONMENT,
    )
    return retained.weights("real_untuned", key, make)
