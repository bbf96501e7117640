"""Runs the training phases in order and skips stages whose result exists for the same settings and input weights."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from time import monotonic, process_time
from typing import Any

import torch

from safedpa.errors import InputError, did_you_mean
from safedpa.networks import Weights, load_weights, save_weights
from safedpa_sim.training.configuration import Configuration
from safedpa_sim.training.export.weights import export_model
from safedpa_sim.training.optimisation import training_device
from safedpa_sim.training.progress import ReportProgress, read_record, silent, write_record
from safedpa_sim.training.stages import TrainingStage, phase_function, stages_of


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
