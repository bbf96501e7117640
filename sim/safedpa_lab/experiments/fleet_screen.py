"""What would be missed if robots with the error of healthy ones were not searched: the price of a cheap screen."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from safedpa.diagnosis.fit.cross_validation import heldout_of
from safedpa.diagnosis.fit.multiple_shooting import shooting_of
from safedpa.diagnosis.search.initial_model import initial_search
from safedpa.dynamics import load_model
from safedpa.records import load_run
from safedpa_lab.experiments.diagnosing import HORIZON
from safedpa_lab.hidden import CAR_EFFECTS, Case, Log, write_cases
from safedpa_lab.hidden.case import ABSORBED

__all__ = ["fleet_screen"]

_SHARE = {False: 0.2, True: 1.0}
"""Of the ordinary strength, in plain and in hard logs: what the search finds in all cases."""
_LIMIT = 0.95
"""Quantile of the healthy robots' errors above which the screen would send a robot to the search."""


def fleet_screen(
    seed: int,
    healthy: int = 24,
    *,
    hard: bool = False,
    report_progress: Callable[[int, int], None] = lambda _done, _all: None,
) -> dict[str, Any]:
    """Errors of healthy cars, and of cars with each effect; how many of these a limit would miss.

    In plain logs effects have a fifth of their ordinary strength, in ``hard`` ones all of it. Healthy cars come with a
    speed servo and with a throttle, as many as there are; each is compared with its own kind.
    """
    weak = [
        Case("screen", seed + 1000 + n, {name: _drawn(name, seed + n, hard)}, drive=CAR_EFFECTS[name].drive, hard=hard)
        for n, name in enumerate(CAR_EFFECTS)
        if not (hard and name in ABSORBED)
    ]
    drives = sorted({item.drive for item in weak})
    quiet = [Case("screen", seed + n, {}, drive=drives[n % len(drives)], hard=hard) for n in range(healthy)]
    errors = _errors([*quiet, *weak], report_progress)
    limits = {
        drive: float(np.quantile([e for case, e in zip(quiet, errors, strict=False) if case.drive == drive], _LIMIT))
        for drive in drives
    }
    rows: list[dict[str, Any]] = [
        {"effect": next(iter(case.effects)), "error": error, "over_limit": error / limits[case.drive]}
        for case, error in zip(weak, errors[len(quiet) :], strict=True)
    ]
    return {
        "seed": seed,
        "healthy": healthy,
        "hard": hard,
        "share_of_ordinary_strength": _SHARE[hard],
        "quantile": _LIMIT,
        "limits": limits,
        "effects": len(rows),
        "missed": [str(row["effect"]) for row in rows if float(row["over_limit"]) <= 1.0],
        "rows": sorted(rows, key=lambda row: float(row["over_limit"])),
    }


def _drawn(name: str, seed: int, hard: bool) -> dict[str, float]:
    return CAR_EFFECTS[name].drawn(np.random.default_rng(seed), _SHARE[hard])


def _errors(cases: Sequence[Case], report_progress: Callable[[int, int], None]) -> list[float]:
    """Held-out error of the given model in each case, with its free parameters refitted."""
    found = []
    with tempfile.TemporaryDirectory(prefix="safedpa-screen-") as folder:
        logs = write_cases(cases, [Path(folder) / str(number) for number in range(len(cases))])
        for number, log in enumerate(logs):
            report_progress(number, len(logs))
            found.append(_error(log))
    return found


def _error(log: Log) -> float:
    model = load_model(log.model)
    runs = [load_run(path, model.system) for path in log.runs]
    return initial_search(model, shooting_of(runs, HORIZON), heldout_of(runs, HORIZON)).error.value
