"""A model that is not affine in the action, relinearised by its own slope, against one that is: the point robot.

With the clean thrust, and with the benchmark's, which saturates at a twentieth of its range. Every row has its own
margin. All filters are told z = mu(e) of the true wind, so that nothing but the form of the model differs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Final, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.errors import InputError
from safedpa.safety.margins.conformal import margins_over_drives, smallest_sample
from safedpa_lab.experiments.paired import holm, mcnemar_exact
from safedpa_lab.experiments.retained_drives import check_record, driven
from safedpa_lab.experiments.seeds import seeds_for
from safedpa_lab.experiments.statistics import mean_interval, wilson_interval
from safedpa_lab.point.driven import driven as drive
from safedpa_lab.point.margin import COVERAGE
from safedpa_lab.point.relinearised_drives import FilteredDriver, model_of, nominal_policy_of, windy
from safedpa_lab.point.relinearised_filter import RelinearisedFilter
from safedpa_sim.point.policy_task import LARGEST_FORCE
from safedpa_sim.point.task import EPISODE_STEPS

__all__ = ["FILTERS", "PLACES", "Relinearised", "Row", "point_relinearised", "row_of"]

ReportProgress = Callable[[int, int], None]

PLACES: Final = (("clean", "policy"), ("stock", "disturbed"))
"""Thrust and nominal action. A disturbance of the clean thrust would tell little: it is affine all over its range; the policy
alone with the stock one was left out for time alone."""
FILTERS: Final = {
    "affine": ("affine", "nominal"),
    "nominal": ("free", "nominal"),
    "own": ("free", "own"),
    "truth": ("truth", "own"),
}
"""Kind of model, and what it is linearised about."""
_FIRST_GUESS: Final = 0.002
"""m; the margin with which the calibrating drives go, behind the row's own filter."""


@final
@dataclass(frozen=True)
class Row:
    """One filter with one thrust and one kind of nominal action; plain values, so that it can be kept in a file."""

    thrust: str
    filter: str
    nominal: str
    models: str
    directions: int
    episodes: int
    """Of each direction."""
    steps: int
    drives: int
    drive_steps: int
    seed: int
    """Of what is counted."""
    calibration: int
    """The seed of the drives that calibrate."""


@final
@dataclass(frozen=True)
class Relinearised:
    """What is to be run. Raises InputError for numbers that make no experiment."""

    models: Path = Path()
    directions: int = 24
    episodes: int = 2
    steps: int = EPISODE_STEPS
    drives: int = 100
    drive_steps: int = 200
    seed: int = 2400
    processes: int = 1
    record: Path | None = None

    def __post_init__(self) -> None:
        lows = {"directions": 1, "episodes": 1, "steps": 1, "processes": 1, "seed": 0, "drive_steps": 2}
        for name, low in {**lows, "drives": smallest_sample(COVERAGE)}.items():
            if getattr(self, name) < low:
                raise InputError(f"--{name}: got {getattr(self, name)}, wanted {low} or more")
        seeds_for("evaluation", 1, self.seed)

    def rows(self) -> list[Row]:
        """Place by place, filter by filter."""
        plain = str(self.models), self.directions, self.episodes, self.steps, self.drives, self.drive_steps
        seeds = seeds_for("evaluation", 1, self.seed)[0], seeds_for("calibration", 1, self.seed)[0]
        return [Row(thrust, name, nominal, *plain, *seeds) for thrust, nominal in PLACES for name in FILTERS]


def point_relinearised(
    asked: Relinearised, report_progress: ReportProgress = lambda _done, _all: None
) -> dict[str, Any]:
    """``rows``, with margins and what was counted, and ``against``: tests between the forms on the same episodes."""
    check_record(asked.record, Row, row_of)
    rows = driven(row_of, asked.rows(), asked.processes, report_progress, asked.record)
    reported = {
        name: getattr(asked, name) for name in ("directions", "episodes", "steps", "drives", "drive_steps", "seed")
    }
    seeds = {"evaluation_seed": rows[0]["seed"], "calibration_seed": rows[0]["calibration"]}
    plain = [{key: value for key, value in row.items() if key != "models"} for row in rows]
    return {**reported, **seeds, "coverage": COVERAGE, "force": LARGEST_FORCE, "rows": plain, "against": _against(rows)}


def row_of(row: Row) -> dict[str, Any]:
    """The row's margin, behind its own filter with a first guess, and its episodes with that margin."""
    errors = _calibrated(row)
    epsilon, every = max(0.0, margins_over_drives(errors, COVERAGE)[0]), np.concatenate(errors)
    towards = np.repeat(2.0 * np.pi * np.arange(row.directions) / row.directions, row.episodes)
    driver = _driver(row, towards, row.seed, epsilon)
    found = drive(driver, driver.task, row.steps)
    seen, count, safe = np.concatenate(driver.seen()), len(towards), found.cost == 0.0
    return {
        **{item.name: getattr(row, item.name) for item in fields(row)},
        "epsilon": epsilon,
        "calibrated_on": len(every),
        "median_error": float(np.median(np.abs(seen))) if len(seen) else None,
        "error_99": float(np.quantile(seen, COVERAGE)) if len(seen) else None,
        "near": len(seen),
        "count": count,
        "safe": int(safe.sum()),
        "safe_interval": list(wilson_interval(int(safe.sum()), count)),
        "unsafe_steps": int(found.cost.sum()),
        "least_room": float(found.least_room.min()),
        "goals": mean_interval(found.goals),
        "corrected": found.corrected,
        "relaxed": found.relaxed,
        "microseconds": 1e6 * driver.seconds / count / row.steps,
        "safe_each": "".join("1" if one else "0" for one in safe),
        "goals_each": found.goals.astype(int).tolist(),
    }


def _calibrated(row: Row) -> list[FloatArray]:
    """The errors [m] along each drive."""
    towards = np.random.default_rng([row.calibration, 61]).uniform(0.0, 2.0 * np.pi, row.drives)
    driver = _driver(row, towards, row.calibration, _FIRST_GUESS)
    for _ in range(row.drive_steps):
        driver.task.advance(driver.act())
    return driver.errors()


def _driver(row: Row, towards: FloatArray, seed: int, epsilon: float) -> FilteredDriver:
    kind, about = FILTERS[row.filter]
    models = Path(row.models)
    task = windy(row.thrust, towards, LARGEST_FORCE, seed)
    nominal = nominal_policy_of(row.nominal, row.thrust, task, models, seed)
    return FilteredDriver(task, model_of(kind, row.thrust, task, models), RelinearisedFilter(epsilon, about), nominal)


def _against(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Each relinearised filter against the affine one: exact McNemar over episodes, Holm over all lines; goals less."""
    by = {(row["thrust"], row["nominal"], row["filter"]): row for row in rows}
    found = []
    for (thrust, nominal, name), row in by.items():
        if name != "affine":
            affine = by[thrust, nominal, "affine"]
            pair = [np.array([flag == "1" for flag in one["safe_each"]]) for one in (row, affine)]
            more, fewer, p = mcnemar_exact(*pair)
            goals = np.array(row["goals_each"], dtype=np.float64) - np.array(affine["goals_each"], dtype=np.float64)
            reported = {
                "thrust": thrust,
                "nominal": nominal,
                "filter": name,
                "only_it": more,
                "only_affine": fewer,
                "mcnemar": p,
            }
            found.append({**reported, "goals_less": mean_interval(goals)})
    for line, p in zip(found, holm([line["mcnemar"] for line in found]), strict=True):
        line["holm"] = p
    return found
