"""A work and its outcome as files, on the way to the process that carries it out and back."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np

from safedpa.dynamics import parse_model
from safedpa.live.work import SearchJob, WorkOutcome
from safedpa.records.run import Run, Stretch
from safedpa.records.writers.tables import atomic_path

__all__ = ["read_outcome", "read_work", "write_outcome", "write_work"]

_ROWS, _TEXT, _OUTCOME = "rows.npz", "work.json", "outcome.json"
_TEXTS = ("task", "model", "horizon", "effect", "document", "footprint")


def write_work(work: SearchJob, folder: Path) -> None:
    """Writes a work into a folder of its own."""
    run = work.run
    stretches = np.array([(part.start, part.stop) for part in run.stretches], dtype=np.int64).reshape(-1, 2)
    np.savez(folder / _ROWS, t=run.t, states=run.states, actions=run.actions, stretches=stretches)
    phrase = {**{name: getattr(work, name) for name in _TEXTS}, "name": run.name}
    phrase["folder"] = None if work.folder is None else str(work.folder.absolute())
    (folder / _TEXT).write_text(json.dumps(phrase), encoding="utf-8")


def read_work(folder: Path) -> SearchJob:
    """The work that ``write_work`` wrote."""
    phrase = json.loads((folder / _TEXT).read_text(encoding="utf-8"))
    name, footprint, place = phrase.pop("name"), tuple(phrase.pop("footprint")), phrase.pop("folder")
    weights = None if place is None else Path(place)
    with np.load(folder / _ROWS) as rows:
        stretches = tuple(Stretch(int(start), int(stop)) for start, stop in rows["stretches"])
        run = Run(
            name, parse_model(phrase["model"], weights).system, rows["t"], rows["states"], rows["actions"], stretches
        )
    return SearchJob(run=run, footprint=footprint, folder=weights, **phrase)


def write_outcome(outcome: WorkOutcome, folder: Path) -> None:
    """Writes an outcome, whole or not at all."""
    with atomic_path(folder / _OUTCOME) as temporary:
        temporary.write_text(json.dumps(asdict(outcome)), encoding="utf-8")


def read_outcome(folder: Path) -> WorkOutcome | None:
    """The outcome that ``write_outcome`` wrote; None when there is none."""
    path = folder / _OUTCOME
    if not path.exists():
        return None
    phrase = json.loads(path.read_text(encoding="utf-8"))
    return WorkOutcome(**{**phrase, "effects": tuple(phrase["effects"])})
