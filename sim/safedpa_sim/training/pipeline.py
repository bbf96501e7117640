"""Runs the training phases in order and skips stages whose result exists for the same settings and input weights.

``stages_of`` lists the stages of a robot: the paper's phases and the ablations that they are compared with.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from math import radians
from pathlib import Path
from time import monotonic, process_time
from typing import Any, Final, final

import torch

from safedpa.errors import InputError, did_you_mean
from safedpa.extras import need
from safedpa.networks import Weights, load_weights, save_weights
from safedpa.networks.frame import frame_of
from safedpa_sim.training.configuration import Configuration
from safedpa_sim.training.export.weights import export_model
from safedpa_sim.training.optimisation import training_device
from safedpa_sim.training.phases.phase_1a import train_affine
from safedpa_sim.training.progress import ReportProgress, read_record, silent, write_record


def run_pipeline(
    configuration: Configuration,
    out: Path,
    phases: Iterable[str] = (),
    report_progress: ReportProgress = silent,
    device: str = "cpu",
) -> dict[str, dict[str, Any]]:
    """Runs the named phases, or all phases of the robot, and returns the record of each stage.

    A record has ``"skipped": true`` if the stage's result already existed. Each stage writes its result when it ends:
    weights and model file into ``out``, durations, seeds and losses into ``progress.json``. Raises InputError for an
    unknown phase, a missing earlier phase, or a device that this machine does not have.
    """
    stages = stages_of(configuration.robot, configuration.practice.penalties)
    chosen = tuple(phases) or tuple(stages)
    for name in chosen:
        if name not in stages:
            raise InputError(f"phase '{name}': {did_you_mean(name, stages)}")
    training_device(device)
    out.mkdir(parents=True, exist_ok=True)
    records = {}
    for name in stages:
        if name in chosen:
            for stage in stages[name]:
                records[stage.name] = _run(stage, configuration, out, report_progress, device)
    return records


def tune_on_runs(
    configuration: Configuration,
    weights: Path,
    runs: list[Path],
    columns: Path | None,
    out: Path,
    what: str = "all",
    report_progress: ReportProgress = silent,
) -> dict[str, Any]:
    """Tunes a weights file on recorded runs, writes ``ROBOT_learned`` with its model file, and returns the summary."""
    given = load_weights(weights)
    tune = phase_function("phase_3", "tune_on_runs")
    tuned, summary = tune(configuration, given, runs, columns, out, report_progress, what)
    export_model(tuned, configuration.simulator, out / f"{configuration.robot}_learned.toml")
    return dict(summary)


def _run(
    stage: TrainingStage, configuration: Configuration, out: Path, report_progress: ReportProgress, device: str
) -> dict[str, Any]:
    target = out / f"{stage.target.format(robot=configuration.robot)}.toml"
    given = _input_weights(stage, configuration, out)
    digest = configuration.digest(*stage.sections)
    made_from = given.digest if given else ""
    known = read_record(out).get(stage.name, {})
    if known.get("digest") == digest and known.get("from") == made_from and _has_result(target, stage):
        return {**known, "skipped": True}
    started, used = monotonic(), process_time()
    # A stage without a source ignores the weights, so None is fine there although the type says Weights.
    weights, summary = stage.train(configuration, given, out, report_progress, device)  # type: ignore[arg-type]
    if stage.has_model_file:
        export_model(weights, configuration.simulator, target)
    else:
        save_weights(weights, target.with_suffix(".safetensors"))
    record = {
        "digest": digest,
        "from": made_from,
        "file": target.with_suffix(".safetensors").name,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "seconds": round(monotonic() - started, 1),
        "processor_seconds": round(process_time() - used, 1),
        "seed": configuration.seed,
        "device": device,
        "threads": torch.get_num_threads(),
        **summary,
    }
    write_record(out, {**read_record(out), stage.name: record})
    return record


def _input_weights(stage: TrainingStage, configuration: Configuration, out: Path) -> Weights | None:
    """Returns the input weights of a stage, without the tensors that it or a later stage produces."""
    if not stage.source:
        return None
    path = out / f"{stage.source.format(robot=configuration.robot)}.safetensors"
    if not path.exists():
        raise InputError(f"phase {stage.name}: no {path}; run the phases before it first, or all of them")
    weights = load_weights(path)
    for earlier in stage.needs:
        if not weights.has(earlier):
            raise InputError(f"phase {stage.name}: {path} holds no {earlier}; run the phases before it first")
    retained = {name: tensor for name, tensor in weights.tensors.items() if not name.startswith(stage.drops)}
    if any(name.startswith("phi.") for name in retained):
        return Weights(retained, weights.description)
    # No phi yet: the history length that phase 2 is going to train it for comes from the configuration.
    return Weights(retained, replace(weights.description, history=configuration.history))


def _has_result(model_file: Path, stage: TrainingStage) -> bool:
    weights = model_file.with_suffix(".safetensors")
    exists = weights.exists() and (model_file.exists() or not stage.has_model_file)
    return exists and all(load_weights(weights).has(name) for name in stage.adds)


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
