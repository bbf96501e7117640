"""The phases in order; what is there already, from the same configuration and the same weights, is not made again."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from time import monotonic
from typing import Any, Final, final

import torch

from safedpa.errors import InputError, did_you_mean
from safedpa.networks import Weights, load_weights
from safedpa_sim.training.configuration import Configuration
from safedpa_sim.training.phase_1a import train_affine, training_device
from safedpa_sim.training.progress import Tell, read_record, silent, write_record
from safedpa_sim.training.weights_export import export_model

__all__ = ["PHASES", "run_pipeline", "tune_on_runs"]

PHASES: Final = ("1a", "1b", "2", "3", "ablations")
"""In the order in which they run."""

_Result = tuple[Weights, dict[str, Any]]


@final
@dataclass(frozen=True)
class _Stage:
    """One thing that is trained: from which weights, into which, and by whom."""

    name: str
    sections: tuple[str, ...]
    """Sections of the configuration that decide the result."""
    source: str
    """The file it begins with; nothing for one that begins from nothing."""
    target: str
    adds: tuple[str, ...]
    """Networks that are in its result."""
    train: Callable[[Configuration, Weights, Path, Tell, str], _Result]


def run_pipeline(
    configuration: Configuration,
    out: Path,
    phases: Iterable[str] = PHASES,
    tell: Tell = silent,
    device: str = "cpu",
) -> dict[str, dict[str, Any]]:
    """Runs the named phases and returns their records; each says ``"skipped": true`` when it was there already.

    Every result is written as soon as it is there: weights and model file into ``out``, seconds, seeds and losses into
    ``progress.json``. Raises InputError for an unknown phase, an earlier phase that is missing, or a device that this
    machine does not have.
    """
    chosen = tuple(phases)
    for name in chosen:
        if name not in PHASES:
            raise InputError(f"phase '{name}': {did_you_mean(name, PHASES)}")
    training_device(device)
    out.mkdir(parents=True, exist_ok=True)
    records = {}
    for name in PHASES:
        if name in chosen:
            for stage in _STAGES[name]:
                records[stage.name] = _run(stage, configuration, out, tell, device)
    return records


def tune_on_runs(
    configuration: Configuration,
    weights: Path,
    runs: list[Path],
    columns: Path | None,
    out: Path,
    what: str = "all",
    tell: Tell = silent,
) -> dict[str, Any]:
    """Tunes a weights file on recorded runs; writes ``car_learned`` with its model file, and returns the summary."""
    given = load_weights(weights)
    tune = _phase_function("phase_3", "tune_on_runs")
    tuned, summary = tune(configuration, given, runs, columns, out, tell, what)
    export_model(tuned, configuration.simulator, out / f"{configuration.robot}_learned.toml")
    return dict(summary)


def _run(stage: _Stage, configuration: Configuration, out: Path, tell: Tell, device: str) -> dict[str, Any]:
    target = out / f"{stage.target.format(robot=configuration.robot)}.toml"
    given = _given(stage, configuration, out)
    digest = configuration.digest(*stage.sections)
    made_from = given.digest if given else ""
    known = read_record(out).get(stage.name, {})
    if known.get("digest") == digest and known.get("from") == made_from and _is_there(target, stage):
        return {**known, "skipped": True}
    started = monotonic()
    made, summary = stage.train(configuration, given, out, tell, device)  # type: ignore[arg-type]  # none wants none
    export_model(made, configuration.simulator, target)
    record = {
        "digest": digest,
        "from": made_from,
        "file": target.with_suffix(".safetensors").name,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "seconds": round(monotonic() - started, 1),
        "seed": configuration.seed,
        "device": device,
        "threads": torch.get_num_threads(),
        **summary,
    }
    write_record(out, {**read_record(out), stage.name: record})
    return record


def _given(stage: _Stage, configuration: Configuration, out: Path) -> Weights | None:
    """The weights that a stage begins with, without what it makes itself and what comes after it."""
    if not stage.source:
        return None
    path = out / f"{stage.source.format(robot=configuration.robot)}.safetensors"
    if not path.exists():
        raise InputError(f"phase {stage.name}: no {path}; run the phases before it first, or all of them")
    weights = load_weights(path)
    for earlier in _BEFORE.get(stage.name, ()):
        if not weights.has(earlier):
            raise InputError(f"phase {stage.name}: {path} holds no {earlier}; run the phases before it first")
    dropped = _AFTER.get(stage.name, ())
    kept = {name: tensor for name, tensor in weights.tensors.items() if not name.startswith(dropped)}
    if any(name.startswith("phi.") for name in kept):
        return Weights(kept, weights.description)
    return Weights(kept, replace(weights.description, history=configuration.history))  # how phi is about to look back


def _is_there(model_file: Path, stage: _Stage) -> bool:
    weights = model_file.with_suffix(".safetensors")
    return model_file.exists() and weights.exists() and all(load_weights(weights).has(name) for name in stage.adds)


def _phase_function(module: str, name: str) -> Callable[..., Any]:
    """A phase's function, imported when it is called: its packages belong to the extra ``train``."""
    try:
        found: Callable[..., Any] = getattr(importlib.import_module(f"safedpa_sim.training.{module}"), name)
    except ModuleNotFoundError as error:
        raise InputError(
            f"{module.replace('_', ' ')}: the module '{error.name}' is not installed; say pip install 'safedpa[train]'"
        ) from error
    return found


def _affine(variant: str) -> Callable[..., _Result]:
    def train(configuration: Configuration, _given: Weights | None, out: Path, tell: Tell, device: str) -> _Result:
        return train_affine(configuration, out, tell, device, variant)  # type: ignore[arg-type]

    return train


def _later(module: str, name: str, **options: Any) -> Callable[..., _Result]:
    def train(*arguments: Any) -> _Result:
        result: _Result = _phase_function(module, name)(*arguments, **options)
        return result

    return train


def _penalised(configuration: Configuration, given: Weights, out: Path, tell: Tell, device: str) -> _Result:
    """RMA-P: a policy that is punished for contacts in training, in place of a filter."""
    train = _later("phase_1b", "train_policy", penalty=configuration.ablations.penalty)
    return train(configuration, given, out, tell, device)


_SIMULATED, _LEARNED = "{robot}_simulated", "{robot}_learned"
_TO_POLICY = ("phase_1a", "phase_1b")
_TO_HISTORY = (*_TO_POLICY, "phase_2")
_STAGES: Final = {
    "1a": (_Stage("1a", ("phase_1a",), "", _SIMULATED, ("mu", "f", "g"), _affine("1a")),),
    "1b": (_Stage("1b", _TO_POLICY, _SIMULATED, _SIMULATED, ("policy",), _later("phase_1b", "train_policy")),),
    "2": (_Stage("2", _TO_HISTORY, _SIMULATED, _SIMULATED, ("phi",), _later("phase_2", "train_history_encoder")),),
    "3": (_Stage("3", (*_TO_HISTORY, "phase_3"), _SIMULATED, _LEARNED, ("phi",), _later("phase_3", "tune")),),
    "ablations": (
        _Stage("fix", ("phase_1a", "ablations"), "", "{robot}_fix", ("f", "g"), _affine("fix")),
        _Stage("mix", ("phase_1a", "ablations"), "", "{robot}_mix", ("f", "g"), _affine("mix")),
        _Stage("rma_p", (*_TO_HISTORY, "ablations"), _SIMULATED, "{robot}_rma_p", ("policy", "phi"), _penalised),
    ),
}
_BEFORE: Final = {"2": ("policy",), "3": ("policy", "phi"), "rma_p": ("policy", "phi")}
"""Networks that must be there before a stage begins."""
_AFTER: Final = {"1b": ("policy.", "observation_", "phi."), "2": ("phi.",), "rma_p": ("policy.", "observation_")}
"""Tensors that a stage makes itself, or that were made from those: it must not see them."""
