"""The judgements of many hidden-effect cases as figures, each share with its 95 % interval."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from safedpa_lab.experiments.statistics import wilson_interval
from safedpa_lab.hidden.judge import Outcome

__all__ = ["summary"]


def summary(suites: Iterable[str], outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Rows by suite and, where one effect is hidden, by effect; and the cases that were not right."""
    rows, effects = [], []
    for suite in suites:
        own = [item for item in outcomes if item.suite == suite]
        rows.append(_row(suite, "all", own))
        for name in sorted({item.hidden[0] for item in own if len(item.hidden) == 1}):
            effects.append(_row(suite, name, [item for item in own if item.hidden == (name,)]))
    missed = [_missed(item) for item in outcomes if not item.right or item.wrong or item.false_laws]
    return {"suites": rows, "effects": effects, "missed": missed}


def _missed(item: Outcome) -> dict[str, Any]:
    return {
        "case": item.case,
        "hidden": list(item.hidden),
        "verdict": item.verdict,
        "added": [*item.added, *item.reported],
    }


def _row(suite: str, effect: str, outcomes: Sequence[Outcome]) -> dict[str, Any]:
    deviations = np.abs([value for item in outcomes for value in item.deviations])
    ratios = np.array([item.error_ratio for item in outcomes if np.isfinite(item.error_ratio)])
    seconds = np.array([item.seconds for item in outcomes])
    processor = np.array([item.processor_seconds for item in outcomes if np.isfinite(item.processor_seconds)])
    hidden = any(item.hidden for item in outcomes)
    return {
        "suite": suite,
        "effect": effect,
        "cases": len(outcomes),
        "right": _share([item.right for item in outcomes]),
        "named_first": _share([item.first_named for item in outcomes]) if hidden else None,
        "all_named": _share([item.all_named for item in outcomes]) if hidden else None,
        "wrong_additions": _share([bool(item.wrong) for item in outcomes]),
        "false_laws": _share([bool(item.false_laws) for item in outcomes]),
        "parameters_within_two": _share([value <= 2.0 for value in deviations]) if len(deviations) else None,
        "error_ratio_median": float(np.median(ratios)) if len(ratios) else None,
        "error_ratio_largest": float(ratios.max()) if len(ratios) else None,
        "error_ratio_within": _share([value <= 1.1 for value in ratios]) if len(ratios) else None,
        "seconds_median": float(np.median(seconds)),
        "seconds_largest": float(seconds.max()),
        "processor_seconds_median": float(np.median(processor)) if len(processor) else None,
        "processor_seconds_largest": float(processor.max()) if len(processor) else None,
    }


def _share(hits: Sequence[Any]) -> dict[str, Any]:
    """Hits, trials and the 95 % interval of the share."""
    count = int(sum(bool(hit) for hit in hits))
    return {"hits": count, "of": len(hits), "interval_95": [round(end, 4) for end in wilson_interval(count, len(hits))]}
