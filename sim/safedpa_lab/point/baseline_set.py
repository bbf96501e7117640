"""All baselines on both tasks: trained one after the other, what is there already left alone; read again afterwards."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any, Final

from safedpa.errors import InputError, did_you_mean
from safedpa_lab.point.plan import BASELINES, Plan
from safedpa_lab.point.policy_file import BaselinePolicy, load_policy
from safedpa_sim.training.progress import ReportProgress, silent

__all__ = [
    "LARGEST_FORCE",
    "PUBLISHED",
    "SHIPPED",
    "TASKS",
    "baseline_named",
    "baselines_in",
    "folder_of",
    "seeds_of",
    "train_baselines",
]

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


SHIPPED: Final = Path(str(files("safedpa_sim.point"))) / "weights"


def train_baselines(
    out: Path,
    names: Iterable[str] = BASELINES,
    tasks: Iterable[str] = tuple(TASKS),
    seeds: Iterable[int] = (0,),
    report_progress: ReportProgress = silent,
    changes: Mapping[str, Any] = {},
) -> dict[str, dict[str, Any]]:
    """Trains each name on each task from each seed into ``out``/seed_N/KEY.safetensors; accounts by seed_N/KEY.

    ``changes`` are fields of ``Plan`` that are other than the task's; KEY is ``Plan.key``'s. Raises InputError for
    names of baselines and tasks that are none.
    """
    from safedpa_lab.point.baselines import train_baseline

    chosen = [(name, task, seed) for seed in seeds for task in tasks for name in names]
    for name, task, _ in chosen:
        _known("baseline", name, BASELINES)
        _known("task", task, TASKS)
    accounts = {}
    for name, task, seed in chosen:
        plan = replace(TASKS[task], seed=seed, **changes)
        key = f"{folder_of(seed)}/{plan.key(name, task)}"
        accounts[key] = train_baseline(name, plan, out / f"{key}.safetensors", report_progress)
    return accounts


def folder_of(seed: int) -> str:
    """Where the policies of one training seed lie."""
    return f"seed_{seed}"


def baselines_in(folder: Path, seed: int = 0) -> dict[str, dict[str, Any]]:
    """The accounts of one seed's policies in a folder, or else those that ship, by NAME_TASK and what follows it."""
    found = {}
    for place in (SHIPPED, folder):
        for path in sorted((place / folder_of(seed)).glob("*.safetensors")):
            found[path.stem] = load_policy(path).reported
    return found


def baseline_named(key: str, folder: Path, seed: int = 0) -> BaselinePolicy:
    """KEY of a training seed from the folder, or else the one that ships. Raises InputError when there is none."""
    own, shipped = (place / folder_of(seed) / f"{key}.safetensors" for place in (folder, SHIPPED))
    for path in (own, shipped):
        if path.exists():
            return load_policy(path)
    raise InputError(f"{own}: no such file, and none ships; train it with 'safedpa train-baselines'")


def seeds_of(key: str, folder: Path) -> tuple[int, ...]:
    """The training seeds of which there is a policy of that KEY, in the folder or shipped."""
    paths = [path for place in (folder, SHIPPED) for path in place.glob(f"seed_*/{key}.safetensors")]
    return tuple(sorted({int(path.parent.name.removeprefix("seed_")) for path in paths}))


def _known(kind: str, name: str, names: Iterable[str]) -> None:
    if name not in names:
        raise InputError(f"{kind} '{name}': {did_you_mean(name, tuple(names))}")
