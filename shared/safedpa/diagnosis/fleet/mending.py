"""The model file mended with what a fleet has in common, once robots confirm it that had no part in its numbers."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Protocol, TypeVar

import numpy as np

from safedpa.diagnosis.fleet.common import (
    Common,
    Confirmation,
    MendTask,
    confirmed,
    mended_error,
    mended_model,
    mended_settings,
)
from safedpa.diagnosis.fleet.document import Analysis
from safedpa.diagnosis.fleet.one_robot import Task
from safedpa.dynamics import LearnedBase, PhysicsModel, load_model, save_model, write_model
from safedpa.records.atomic import atomic_path

__all__ = ["Mended", "Workers", "mended"]

Job = TypeVar("Job")
Answer = TypeVar("Answer")
Mended = list[tuple[Common, Confirmation]]
"""What was tried, and whether it held beside what held before it."""

_MOST_TRIED = 40
"""Robots on which a mended model is tried, evenly spread: more would not change what a coin says."""


class Workers(Protocol):
    """Who does the work: answers in the order in which they are done, ``failed(job, reason)`` for what went wrong."""

    def __call__(
        self, work: Callable[[Job], Answer], jobs: Sequence[Job], failed: Callable[[Job, str], Answer]
    ) -> Iterator[Answer]:
        """Runs ``work`` on every job somewhere."""


def mended(analysis: Analysis, tasks: Sequence[Task], workers: Workers, path: Path) -> Mended:
    """Tries what the fleet has in common on robots, each with the others' numbers; writes the model with what holds.

    First what nearly all were found to have, one after the other; then, beside it, the best of what shows in all
    together only. Nothing is left at ``path`` where nothing holds.
    """
    path.unlink(missing_ok=True)  # of an earlier fleet
    if not tasks:
        return []
    told: Mended = []
    held: list[Common] = []
    errors: Mapping[str, float] = {item.name: item.error_before for item in analysis.outcomes if item.judged}
    steps = [[item] for item in analysis.common] + ([list(analysis.together)] if analysis.together else [])
    for options in steps:
        tried = [(item, _errors([*held, item], analysis, tasks, workers)) for item in options]
        best, after = max(tried, key=lambda pair: confirmed(errors, pair[1]).fall)
        found = confirmed(errors, after)
        told.append((best, found))
        if found.holds:
            held.append(best)
            errors = after
    if held:
        _save(mended_model(load_model(tasks[0].options.model), mended_settings(analysis.robot, held)), path)
    return told


def _errors(
    common: Sequence[Common], analysis: Analysis, tasks: Sequence[Task], workers: Workers
) -> Mapping[str, float]:
    """Held-out errors by robot, each with the other robots' numbers."""
    known = {item.name for item in analysis.outcomes if item.judged}
    judged = [task for task in tasks if task.robot.name in known]
    picked = np.unique(np.linspace(0, len(judged) - 1, min(len(judged), _MOST_TRIED)).astype(int))
    jobs = [
        MendTask(task.robot, task.options, mended_settings(analysis.robot, common, task.robot.name))
        for task in (judged[index] for index in picked)
    ]
    return dict(workers(mended_error, jobs, _not_tried))


def _not_tried(task: MendTask, _reason: str) -> tuple[str, float]:
    return task.robot.name, float("nan")


def _save(model: PhysicsModel, path: Path) -> None:
    if isinstance(model.base, LearnedBase):
        save_model(model, path)
        return
    with atomic_path(path) as temporary:
        temporary.write_text(write_model(model), encoding="utf-8")
