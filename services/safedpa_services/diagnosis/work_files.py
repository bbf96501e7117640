"""The exchange with the process that runs a job: job and result as files, and a signal."""

from __future__ import annotations

import json
import signal
from dataclasses import asdict
from pathlib import Path

import numpy as np

from safedpa.dynamics import parse_model
from safedpa.live.search_jobs import SearchJob, WorkOutcome
from safedpa.records.run import Run, Stretch
from safedpa.records.writers.tables import atomic_path

PAUSE_SECONDS = 1.0
"""Length of a pause, in which a drive that misses ticks has the processor."""
PAUSE_SIGNAL = signal.SIGURG
"""Has no effect on a process that does not handle it yet, because it is still starting."""
CPU_SECONDS = 300
"""Limit of a job's processor time; a search in 15 s of a car's driving takes 4 s."""
_ROWS, _TEXT, _OUTCOME = "rows.npz", "work.json", "outcome.json"
_TEXTS = ("task", "model", "horizon", "effect", "document", "footprint")


def write_work(work: SearchJob, folder: Path) -> None:
    """Writes a job into a folder of its own."""
    run = work.run
    stretches = np.array([(part.start, part.stop) for part in run.stretches], dtype=np.int64).reshape(-1, 2)
    np.savez(folder / _ROWS, t=run.t, states=run.states, actions=run.actions, stretches=stretches)
    document = {**{name: getattr(work, name) for name in _TEXTS}, "name": run.name}
    document["folder"] = None if work.folder is None else str(work.folder.absolute())
    (folder / _TEXT).write_text(json.dumps(document), encoding="utf-8")


def read_work(folder: Path) -> SearchJob:
    """Returns the job that ``write_work`` wrote."""
    document = json.loads((folder / _TEXT).read_text(encoding="utf-8"))
    name, footprint, place = document.pop("name"), tuple(document.pop("footprint")), document.pop("folder")
    weights = None if place is None else Path(place)
    with np.load(folder / _ROWS) as rows:
        stretches = tuple(Stretch(int(start), int(stop)) for start, stop in rows["stretches"])
        run = Run(
            name, parse_model(document["model"], weights).system, rows["t"], rows["states"], rows["actions"], stretches
        )
    return SearchJob(run=run, footprint=footprint, folder=weights, **document)


def write_outcome(outcome: WorkOutcome, folder: Path) -> None:
    """Writes a result atomically."""
    with atomic_path(folder / _OUTCOME) as temporary:
        temporary.write_text(json.dumps(asdict(outcome)), encoding="utf-8")


def read_outcome(folder: Path) -> WorkOutcome | None:
    """Returns the result that ``write_outcome`` wrote; None if there is none."""
    path = folder / _OUTCOME
    if not path.exists():
        return None
    document = json.loads(path.read_text(encoding="utf-8"))
    return WorkOutcome(**{**document, "effects": tuple(document["effects"])})
