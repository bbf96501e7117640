"""All baselines on both tasks: trained one after the other, what is there already left alone; read again afterwards."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any, Final

from safedpa.errors import InputError, did_you_mean
from safedpa_lab.point.plan import BASELINES, Plan
from safedpa_lab.point.policy_file import BaselinePolicy, load_policy
from safedpa_sim.training.progress import Tell, silent

__all__ = ["LARGEST_FORCE", "PUBLISHED", "TASKS", "baseline_named", "baselines_in", "train_baselines"]

LARGEST_FORCE: Final = 0.008
"""N, of 0.015 N that the robot can push with."""

TASKS: Final = {"still": Plan(stock=True), "wind": Plan(largest_force=LARGEST_FORCE)}
"""The benchmark's own task, in still air with its thrust; winds of any direction, thrust that does not saturate."""

PUBLISHED: Final = {
    "ppo": (25.4, 55.7),
    "trpo": (27.2, 45.9),
    "ppo_lagrangian": (13.0, 25.8),
    "trpo_lagrangian": (18.5, 23.0),
    "cpo": (20.5, 28.8),
}
"""Reward and cost of an episode after ten million steps. Source: OmniSafe, JMLR 25 (2024), point, goal, level 1."""


def train_baselines(
    out: Path,
    names: Iterable[str] = BASELINES,
    tasks: Iterable[str] = tuple(TASKS),
    steps: int | None = None,
    seed: int = 0,
    tell: Tell = silent,
) -> dict[str, dict[str, Any]]:
    """Trains each name on each task into ``out``/NAME_TASK.safetensors; the accounts by NAME_TASK.

    Raises InputError for names of baselines and tasks that are none.
    """
    from safedpa_lab.point.baselines import train_baseline

    chosen = [(name, task) for task in tasks for name in names]
    for name, task in chosen:
        _known("baseline", name, BASELINES)
        _known("task", task, TASKS)
    accounts = {}
    for name, task in chosen:
        plan = replace(TASKS[task], seed=seed, steps=steps or TASKS[task].steps)
        accounts[f"{name}_{task}"] = train_baseline(name, plan, out / f"{name}_{task}.safetensors", tell)
    return accounts


def baselines_in(folder: Path) -> dict[str, dict[str, Any]]:
    """The accounts of what lies in a folder, by NAME_TASK, in the order of ``BASELINES``."""
    paths = {f"{name}_{task}": folder / f"{name}_{task}.safetensors" for task in TASKS for name in BASELINES}
    return {key: load_policy(path).told for key, path in paths.items() if path.exists()}


def baseline_named(name: str, task: str, folder: Path) -> BaselinePolicy:
    """NAME_TASK from the folder, or else the one that ships. Raises InputError when there is none."""
    own = folder / f"{name}_{task}.safetensors"
    shipped = Path(str(files("safedpa_sim.point"))) / "weights" / own.name
    for path in (own, shipped):
        if path.exists():
            return load_policy(path)
    raise InputError(f"{own}: no such file, and none ships; train it with 'safedpa train-baselines'")


def _known(kind: str, name: str, names: Iterable[str]) -> None:
    if name not in names:
        raise InputError(f"{kind} '{name}': {did_you_mean(name, tuple(names))}")
