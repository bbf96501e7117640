"""The training stages of each robot, in order: the paper's phases and the ablations that they are compared with."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from math import radians
from pathlib import Path
from typing import Any, Final, final

from safedpa.extras import need
from safedpa.networks import Weights, load_weights
from safedpa.networks.frame import frame_of
from safedpa_sim.training.configuration import Configuration
from safedpa_sim.training.phases.phase_1a import train_affine
from safedpa_sim.training.progress import ReportProgress, read_record

Trained = tuple[Weights, dict[str, Any]]
"""Weights, and a summary for the training record."""

Train = Callable[[Configuration, Weights, Path, ReportProgress, str], Trained]


@final
@dataclass(frozen=True)
class TrainingStage:
    """One training step: its input file, its output file and the function that trains it."""

    name: str
    sections: tuple[str, ...]
    """Sections of the configuration that the result depends on."""
    source: str
    """Name of the input weights file; empty if training starts from scratch."""
    target: str
    adds: tuple[str, ...]
    """Networks that the result contains."""
    train: Train
    needs: tuple[str, ...] = ()
    """Networks that the input must contain."""
    drops: tuple[str, ...] = ()
    """Prefixes of tensor names that are removed from the input: this stage or a later one produces them."""
    has_model_file: bool = True
    """Whether a model file is written next to the weights. False if the networks do not predict the robot's state."""


def stages_of(robot: str, penalties: tuple[float, ...] = ()) -> dict[str, tuple[TrainingStage, ...]]:
    """Returns the stages of each phase, in order.

    A robot without a policy task has phases 1a and 2 only. With ``penalties``, a car's ablations also include PPO
    without a latent, and RMA-P is the best policy of the penalty grid. Raises InputError for a robot for which no
    network frame is defined.
    """
    if robot in _STAGES:
        return {**_STAGES[robot], "ablations": _grid(penalties)} if penalties else _STAGES[robot]
    frame_of(robot)
    phases = _common(_LEARNED)
    return {"1a": phases["1a"], "2": tuple(replace(stage, needs=()) for stage in phases["2"])}


def phase_function(module: str, name: str) -> Callable[..., Any]:
    """Imports and returns a phase's function; late, because torch and the others belong to the extra ``train``."""
    need("train", what=module.replace("_", " "))
    found: Callable[..., Any] = getattr(importlib.import_module(f"safedpa_sim.training.phases.{module}"), name)
    return found


def _affine(variant: str, alone: Mapping[str, float] | None = None) -> Train:
    def train(
        configuration: Configuration, _given: Weights | None, out: Path, report_progress: ReportProgress, device: str
    ) -> Trained:
        return train_affine(configuration, out, report_progress, device, variant, alone)

    return train


def _deferred(module: str, function: str, **options: Any) -> Train:
    def train(*arguments: Any) -> Trained:
        result: Trained = phase_function(module, function)(*arguments, **options)
        return result

    return train


def _penalised(
    configuration: Configuration, given: Weights, out: Path, report_progress: ReportProgress, device: str
) -> Trained:
    """RMA-P: the policy is trained without a filter and penalised for contacts."""
    train = _deferred(
        "phase_1b", "train_policy", name="rma_p", penalty=configuration.ablations.penalty, with_filter=False
    )
    return train(configuration, given, out, report_progress, device)


_SIMULATED, _LEARNED = "{robot}_simulated", "{robot}_learned"
_TO_POLICY = ("phase_1a", "imitation", "phase_1b", "practice")
_TO_HISTORY = (*_TO_POLICY, "phase_2")
_ALONE = ("phase_1a", "ablations")
_POLICY = ("policy.", "observation_")


def _common(last: str) -> dict[str, tuple[TrainingStage, ...]]:
    """Returns phases 1a, 1b and 2; ``last`` is the file that phase 2 writes."""
    train_policy = _deferred("phase_1b", "train_policy")
    encode = _deferred("phase_2", "train_history_encoder")
    drops = (*_POLICY, "phi.")
    return {
        "1a": (TrainingStage("1a", ("phase_1a",), "", _SIMULATED, ("mu", "f", "g"), _affine("1a")),),
        "1b": (TrainingStage("1b", _TO_POLICY, _SIMULATED, _SIMULATED, ("policy",), train_policy, drops=drops),),
        "2": (TrainingStage("2", _TO_HISTORY, _SIMULATED, last, ("phi",), encode, ("policy",), ("phi.",)),),
    }


def _with_penalty(name: str, source: str, train: Train) -> TrainingStage:
    sections, target = (*_TO_HISTORY, "ablations"), f"{{robot}}_{name}"
    return TrainingStage(name, sections, source, target, ("policy", "phi"), train, ("policy", "phi"), _POLICY)


def _alone(name: str, environment: Mapping[str, float] | None = None) -> TrainingStage:
    return TrainingStage(name, _ALONE, "", f"{{robot}}_{name}", ("f", "g"), _affine(name, environment))


def _in_wind(direction: int, strength: float = 4.0) -> TrainingStage:
    """Fix for the pendulum: trained in wind from one direction [degrees] only."""
    from math import cos, sin

    towards = radians(direction)
    wind = {"wind.speed": strength * cos(towards), "wind.upward": strength * sin(towards)}
    return _alone(f"fix_{direction}", wind)


def _in_force(direction: int, strength: float = 1.54) -> TrainingStage:
    """Fix for the point robot: trained under a force [m/s2 over its mass] in one direction [degrees] only."""
    from math import cos, sin

    towards = radians(direction)
    force = {"constant_force.ax": strength * cos(towards), "constant_force.ay": strength * sin(towards)}
    return _alone(f"fix_{direction}", force)


def _punished(penalty: float, source: str = _LEARNED) -> TrainingStage:
    """RMA-P with the given penalty; RMA if the penalty is 0."""
    name = f"rma_p_{penalty:g}".replace(".", "_") if penalty else "rma"
    train = _deferred("phase_1b", "train_policy", name=name, penalty=penalty, with_filter=False)
    return _with_penalty(name, source, train)


def _grid(penalties: tuple[float, ...]) -> tuple[TrainingStage, ...]:
    """Returns the car's ablations: Fix, Mix, PPO on Mix, RMA-P for each penalty, and the best one with its own phi."""
    members = tuple(_punished(penalty, _SIMULATED) for penalty in penalties)
    best = _with_penalty("rma_p", _SIMULATED, _best_of(members))
    return (_alone("fix", {}), _alone("mix"), _PPO, *members, replace(best, drops=(*_POLICY, "phi.")))


def _best_of(members: tuple[TrainingStage, ...]) -> Train:
    """Selects the policy with the highest score on development drives and trains a history encoder on its drives."""

    def train(
        configuration: Configuration, given: Weights, out: Path, report_progress: ReportProgress, device: str
    ) -> Trained:
        del given
        record = read_record(out)
        scores = {stage.name: float(record[stage.name]["score"]) for stage in members}
        best = max(scores, key=lambda name: scores[name])
        weights = load_weights(out / record[best]["file"])
        encode = _deferred("phase_2", "train_history_encoder")
        trained, summary = encode(configuration, weights, out, report_progress, device)
        return trained, {**summary, "chosen": best, "scores": scores}

    return train


_PPO = TrainingStage(
    "ppo",
    (*_TO_POLICY, "ablations"),
    "{robot}_mix",
    "{robot}_ppo",
    ("policy",),
    _deferred("phase_1b", "train_policy", name="ppo", with_filter=False),
)
"""PPO without a latent, trained in all environments."""
_SENSED = TrainingStage(
    "17",
    ("phase_1a", "phase_2"),
    "",
    "{robot}_17",
    ("mu", "f", "g", "phi"),
    _deferred("sensed_state", "train_sensed"),
    has_model_file=False,
)
"""Networks on the point robot's 15 sensor readings and z, instead of its five states."""
_STAGES: Final = {
    "car": {
        **_common(_SIMULATED),
        "3": (
            TrainingStage(
                "3",
                (*_TO_HISTORY, "phase_3"),
                _SIMULATED,
                _LEARNED,
                ("phi",),
                _deferred("phase_3", "tune"),
                ("policy", "phi"),
            ),
        ),
        "ablations": (_alone("fix", {}), _alone("mix"), _with_penalty("rma_p", _SIMULATED, _penalised)),
    },
    "pendulum": {
        **_common(_LEARNED),
        "ablations": (
            *(_in_wind(direction) for direction in (45, 135, 225, 315)),
            _alone("mix"),
            _PPO,
            *(_punished(penalty) for penalty in (0.0, 0.1, 1.0, 10.0)),
        ),
    },
    "point": {
        **_common(_LEARNED),
        "ablations": (
            *(_in_force(direction) for direction in (45, 135, 225, 315)),
            _alone("mix"),
            *(_punished(penalty) for penalty in (0.0, 0.1, 0.3, 1.0, 3.0)),
        ),
        "17": (_SENSED,),
    },
}
"""Pendulum and point have no phase 3, because training already uses the simulator that stands in for the robot."""
