"""The margins that ship, and how often they hold on fresh drives: made and counted by one command.

For each robot and model, drives on calibration seeds behind the filter with the margin that ships make the new margins:
for a step, and for a whole drive. Drives on evaluation seeds behind the filter with the new margin tell how many steps
and how many drives it covered, and how many goals each kind of margin costs. Drives are kept as they are made, so that
a run may be cut anywhere and gone on with.
"""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np

from safedpa.dynamics import fingerprint, load_model
from safedpa.errors import InputError, did_you_mean
from safedpa.safety.calibration import MarginCalibration
from safedpa.safety.ceiling import Ceiling
from safedpa.safety.drive_calibration import calibration_from_drives, covered_shares
from safedpa.safety.shipped import margin_for, settings_named
from safedpa_sim.experiments.car_workers import Workers
from safedpa_sim.experiments.margin_drives import DRIVERS, DriveOrder, DriveResult, driven
from safedpa_sim.experiments.seeds import seeds_for
from safedpa_sim.experiments.statistics import clopper_pearson_interval, cluster_interval, mean_interval

__all__ = ["KINDS", "MarginCases", "margins_experiment"]

KINDS = ("conformal", "drive")
"""Margins of a step and of a whole drive."""

Tell = Callable[[int, int], None]


@final
@dataclass(frozen=True)
class MarginCases:
    """What is to be made. Raises InputError for numbers out of range."""

    robots: tuple[str, ...]
    out: Path
    drives: int = 200
    """On calibration seeds; 99 at least for a coverage of 99 %."""
    fresh: int = 200
    """On evaluation seeds, for each kind of margin."""
    kinds: tuple[str, ...] = KINDS
    """Kinds of margin behind which fresh drives are made."""
    seconds: float = 0.0
    """Of a drive; 0: as each robot has it."""
    coverage: float = 0.99
    processes: int = 2
    minutes: float = 0.0
    """After which no new drive begins; 0: until all is done."""

    def __post_init__(self) -> None:
        for name in self.robots:
            if name not in DRIVERS:
                raise InputError(f"--robot '{name}': {did_you_mean(name, DRIVERS)}")
        for kind in self.kinds:
            if kind not in KINDS:
                raise InputError(f"--kind '{kind}': {did_you_mean(kind, KINDS)}")
        if self.drives < 1 or self.fresh < 0 or self.processes < 1 or self.seconds < 0.0 or self.minutes < 0.0:
            raise InputError("--drives and --processes: wanted more than 0; --fresh, --seconds, --minutes: 0 or more")


def margins_experiment(cases: MarginCases, tell: Tell = lambda _done, _all: None) -> dict[str, Any]:
    """One entry a robot: its margins once they are there, what they covered; ``missing`` drives where time ran out."""
    ends = time.monotonic() + 60.0 * cases.minutes if cases.minutes else float("inf")
    total = len(cases.robots) * (cases.drives + len(cases.kinds) * cases.fresh)
    count = _Count(total, tell)
    rows = {}
    with Workers(cases.processes) as workers:
        for name in cases.robots:
            rows[name] = _of_robot(cases, name, workers, ends, count)
    return {"experiment": "margins", "coverage": cases.coverage, "robots": rows, "missing": total - count.done}


@dataclass
class _Count:
    total: int
    tell: Tell
    done: int = 0

    def more(self, number: int) -> None:
        self.done += number
        self.tell(self.done, self.total)


def _of_robot(cases: MarginCases, name: str, workers: Workers, ends: float, count: _Count) -> dict[str, Any]:
    folder = cases.out / name
    seconds = cases.seconds or DRIVERS[name].seconds
    shipped = margin_for(load_model(DRIVERS[name].model))
    orders = [DriveOrder(name, seed, shipped, seconds=seconds) for seed in seeds_for("calibration", cases.drives)]
    made = _driven(folder / "calibration", orders, workers, ends, count)
    if len(made) < len(orders):
        return {"drives": len(made)}
    margin = _calibrated(cases, name, seconds, made)
    margin.save(folder / "margin.toml")
    row: dict[str, Any] = {"drives": len(made), "seconds": seconds, "epsilon": margin.epsilon, "drive": margin.drive}
    row["behind_the_shipped_margin"] = _counted(made, margin, _ceiling(name)) | _driving(made, seconds)
    for kind in cases.kinds:
        fresh = [DriveOrder(name, seed, margin, kind, seconds) for seed in seeds_for("evaluation", cases.fresh)]
        results = _driven(folder / f"fresh-{kind}", fresh, workers, ends, count)
        if results:
            row[f"fresh_{kind}"] = _counted(results, margin, _ceiling(name)) | _driving(results, seconds)
    return row


def _calibrated(cases: MarginCases, name: str, seconds: float, made: Sequence[DriveResult]) -> MarginCalibration:
    first, last = made[0].seed, made[-1].seed
    origin = (
        f"safedpa experiment margins --robot {name} --drives {len(made)}: seeds {first} to {last}, {seconds:g} s each, "
        "in lockstep behind the margin that shipped before"
    )
    own = fingerprint(load_model(DRIVERS[name].model))
    heights = [item.heights for item in made]
    return calibration_from_drives(heights, cases.coverage, time.strftime("%Y-%m-%d"), own, _ceiling(name), origin)


def _ceiling(name: str) -> Ceiling:
    return Ceiling.of_settings(settings_named(DRIVERS[name].settings))


def _driven(
    folder: Path, orders: Sequence[DriveOrder], workers: Workers, ends: float, count: _Count
) -> list[DriveResult]:
    """The results of the orders, in order, up to where time ran out. Those that are kept of the same order are read."""
    folder.mkdir(parents=True, exist_ok=True)
    missing = [order for order in orders if not _path(folder, order).exists()]
    count.more(len(orders) - len(missing))
    for result, order in zip(workers.map(driven, _until(missing, ends)), missing, strict=False):
        _keep(_path(folder, order), result)
        count.more(1)
    return [_kept(path) for path in (_path(folder, order) for order in orders) if path.exists()]


def _until(orders: Sequence[DriveOrder], ends: float) -> Iterator[DriveOrder]:
    for order in orders:
        if time.monotonic() > ends:
            return
        yield order


def _path(folder: Path, order: DriveOrder) -> Path:
    """One file a drive; another margin is another drive."""
    margin = "none" if order.margin is None else _digest_of(order.margin)
    return folder / f"{order.seed}-{order.seconds:g}s-{margin}.npz"


def _digest_of(margin: MarginCalibration) -> str:
    """A few digits that tell one table of margins from another."""
    import hashlib

    numbers = json.dumps([margin.epsilon, margin.drive], sort_keys=True)
    return hashlib.sha256(numbers.encode()).hexdigest()[:8]


def _keep(path: Path, result: DriveResult) -> None:
    about = {
        "seed": result.seed,
        "goals": result.goals,
        "collisions": result.collisions,
        "ticks": result.ticks,
        "statuses": result.statuses,
        "least_h": result.least_h,
        "layer": result.layer,
        "steps": {kind: len(values) for kind, values in result.heights.items()},
    }
    whole = path.with_name(f"new-{path.name}")
    heights = np.concatenate([*result.heights.values(), np.zeros((0, 4))])
    np.savez_compressed(whole, about=np.array(json.dumps(about)), heights=heights)
    whole.replace(path)


def _kept(path: Path) -> DriveResult:
    check_archive(path)
    with np.load(path) as table:
        about, heights = json.loads(str(table["about"])), np.array(table["heights"])
    steps = about.pop("steps")
    parts = np.split(heights, np.cumsum(list(steps.values()))[:-1])
    return DriveResult(heights=dict(zip(steps, parts, strict=False)), **about)


def _counted(results: Sequence[DriveResult], margin: MarginCalibration, ceiling: Ceiling) -> dict[str, Any]:
    """By kind of barrier: the share of steps that each margin covered, and of drives in which it covered every step."""
    drives = [item.heights for item in results]
    rows: dict[str, Any] = {}
    for kind in margin.epsilon:
        near = sum(len(ceiling.errors(kind, heights[kind])) > 0 for heights in drives if kind in heights)
        rows[kind] = {"drives": len(drives), "drives_near": near}
        for name, table in (("conformal", margin.epsilon), ("drive", margin.drive)):
            rows[kind][name] = _covered(covered_shares(drives, kind, table[kind], ceiling), table[kind])
    return {"covered": rows}


def _covered(shares: Any, epsilon: float) -> dict[str, Any]:
    whole = int((shares == 1.0).sum())
    return {
        "epsilon": epsilon,
        "steps": float(shares.mean()),
        "steps_95": list(cluster_interval(shares)),
        "drives": whole / len(shares),
        "drives_95": list(clopper_pearson_interval(whole, len(shares))),
    }


def _driving(results: Sequence[DriveResult], seconds: float) -> dict[str, Any]:
    statuses: Counter[str] = Counter()
    for item in results:
        statuses.update(item.statuses)
    goals = np.array([60.0 * item.goals / seconds for item in results])
    return {
        "drives": len(results),
        "collisions": sum(item.collisions for item in results),
        "goals": sum(item.goals for item in results),
        "goals_a_minute": mean_interval(goals),
        "statuses": dict(sorted(statuses.items())),
        "least_h": min(item.least_h for item in results),
        "layer": {
            "stays": sum(item.layer["stays"] for item in results),
            "longest_seconds": max(item.layer["longest"] * seconds / item.ticks for item in results),
            "fall": max(item.layer["fall"] for item in results),
            "errors": max(item.layer["errors"] for item in results),
            "least_rise": min(item.layer["least_rise"] for item in results),
            "depth": max(item.layer["depth"] for item in results),
        },
    }
