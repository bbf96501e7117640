"""What is trained for each kind of robot, in which order: the paper's phases, and the ablations next to them."""

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
from safedpa_sim.training.phase_1a import train_affine
from safedpa_sim.training.progress import ReportProgress, read_record

__all__ = ["Trained", "TrainingStage", "phase_function", "stages_of"]

Trained = tuple[Weights, dict[str, Any]]
"""Weights, and what is worth recording."""

Train = Callable[[Configuration, Weights, Path, ReportProgress, str], Trained]


@final
@dataclass(frozen=True)
class TrainingStage:
    """One thing that is trained: from which weights, into which, and by whom."""

    name: str
    sections: tuple[str, ...]
    """Sections of the configuration that decide the result."""
    source: str
    """The file it begins with; nothing for one that begins from nothing."""
    target: str
    adds: tuple[str, ...]
    """Networks that are in its result."""
    train: Train
    needs: tuple[str, ...] = ()
    """Networks that must be there before it begins."""
    drops: tuple[str, ...] = ()
    """Beginnings of the names of tensors that it makes itself, or that were made from those: it must not see them."""
    modelled: bool = True
    """Whether the weights are of the robot's own state, so that a model file stands next to them."""


def stages_of(robot: str, penalties: tuple[float, ...] = ()) -> dict[str, tuple[TrainingStage, ...]]:
    """The stages of each phase, in order: of a robot without a task for its policy, dynamics and history alone.

    With ``penalties`` a car's ablations are PPO without a latent as well, and RMA-P as the best of a grid. Raises
    InputError for a kind of robot whose networks have no frame.
    """
    if robot in _STAGES:
        return {**_STAGES[robot], "ablations": _grid(penalties)} if penalties else _STAGES[robot]
    frame_of(robot)
    phases = _common(_LEARNED)
    return {"1a": phases["1a"], "2": tuple(replace(stage, needs=()) for stage in phases["2"])}


def phase_function(module: str, name: str) -> Callable[..., Any]:
    """A phase's function, imported when it is called: its packages belong to the extra ``train``."""
    need("train", what=module.replace("_", " "))
    found: Callable[..., Any] = getattr(importlib.import_module(f"safedpa_sim.training.{module}"), name)
    return found


def _affine(variant: str, alone: Mapping[str, float] | None = None) -> Train:
    def train(
        configuration: Configuration, _given: Weights | None, out: Path, report_progress: ReportProgress, device: str
    ) -> Trained:
        return train_affine(configuration, out, report_progress, device, variant, alone)

    return train


def _later(module: str, function: str, **options: Any) -> Train:
    def train(*arguments: Any) -> Trained:
        result: Trained = phase_function(module, function)(*arguments, **options)
        return result

    return train


def _penalised(
    configuration: Configuration, given: Weights, out: Path, report_progress: ReportProgress, device: str
) -> Trained:
    """RMA-P: a policy that is punished for contacts in training, in place of a filter."""
    train = _later("phase_1b", "train_policy", name="rma_p", penalty=configuration.ablations.penalty, sheltered=False)
    return train(configuration, given, out, report_progress, device)


_SIMULATED, _LEARNED = "{robot}_simulated", "{robot}_learned"
_TO_POLICY = ("phase_1a", "imitation", "phase_1b", "practice")
_TO_HISTORY = (*_TO_POLICY, "phase_2")
_ALONE = ("phase_1a", "ablations")
_POLICY = ("policy.", "observation_")


def _common(last: str) -> dict[str, tuple[TrainingStage, ...]]:
    """Phases 1a, 1b and 2; ``last`` is the file that phase 2 writes."""
    train_policy = _later("phase_1b", "train_policy")
    encode = _later("phase_2", "train_history_encoder")
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
    """Fix for the pendulum: it knows the wind of one direction [degrees] alone."""
    from math import cos, sin

    towards = radians(direction)
    wind = {"wind.speed": strength * cos(towards), "wind.upward": strength * sin(towards)}
    return _alone(f"fix_{direction}", wind)


def _in_force(direction: int, strength: float = 1.54) -> TrainingStage:
    """Fix for the point robot: it knows the force [m/s2 over its mass] of one direction [degrees] alone."""
    from math import cos, sin

    towards = radians(direction)
    force = {"constant_force.ax": strength * cos(towards), "constant_force.ay": strength * sin(towards)}
    return _alone(f"fix_{direction}", force)


def _punished(penalty: float, source: str = _LEARNED) -> TrainingStage:
    """RMA-P with a penalty of its own; RMA without one."""
    name = f"rma_p_{penalty:g}".replace(".", "_") if penalty else "rma"
    train = _later("phase_1b", "train_policy", name=name, penalty=penalty, sheltered=False)
    return _with_penalty(name, source, train)


def _grid(penalties: tuple[float, ...]) -> tuple[TrainingStage, ...]:
    """A car's Fix and Mix, PPO on the latter, RMA-P for each penalty, and the best of those with a phi of its own."""
    members = tuple(_punished(penalty, _SIMULATED) for penalty in penalties)
    best = _with_penalty("rma_p", _SIMULATED, _best_of(members))
    return (_alone("fix", {}), _alone("mix"), _PPO, *members, replace(best, drops=(*_POLICY, "phi.")))


def _best_of(members: tuple[TrainingStage, ...]) -> Train:
    """The member of the highest score on development drives, and a history encoder taught on its drives."""

    def train(
        configuration: Configuration, given: Weights, out: Path, report_progress: ReportProgress, device: str
    ) -> Trained:
        del given
        record = read_record(out)
        scores = {stage.name: float(record[stage.name]["score"]) for stage in members}
        best = max(scores, key=lambda name: scores[name])
        weights = load_weights(out / record[best]["file"])
        made, reported = _later("phase_2", "train_history_encoder")(
            configuration, weights, out, report_progress, device
        )
        return made, {**reported, "chosen": best, "scores": scores}

    return train


_PPO = TrainingStage(
    "ppo",
    (*_TO_POLICY, "ablations"),
    "{robot}_mix",
    "{robot}_ppo",
    ("policy",),
    _later("phase_1b", "train_policy", name="ppo", sheltered=False),
)
"""A policy that knows no latent, in all environments."""
_SENSED = TrainingStage(
    "17",
    ("phase_1a", "phase_2"),
    "",
    "{robot}_17",
    ("mu", "f", "g", "phi"),
    _later("sensed_training", "train_sensed"),
    modelled=False,
)
"""The point's 15 sensed numbers and z, in place of its state of five."""
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
                _later("phase_3", "tune"),
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
"""Pendulum and point have no phase 3: their simulator is the robot."""
