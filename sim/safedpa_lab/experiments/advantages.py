"""Whether what SafeDPA gains or loses against each other method is more than chance."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from safedpa_lab.experiments.paired import holm, mcnemar_exact, sign_flip_exact

__all__ = ["advantages"]

_OWN = "safedpa"


def advantages(tables: Mapping[str, Mapping[str, Mapping[str, Any]]], directions: int) -> list[dict[str, Any]]:
    """SafeDPA against every other method of each question, by outcome: safe, success, and both.

    ``tables`` by question and method. Episodes are paired by start, wind and draws. Episodes in one wind go well or
    badly together, so the exact McNemar test over episodes stands next to one that exchanges whole directions; both by
    Holm's method over all comparisons.
    """
    rows: list[dict[str, Any]] = []
    for question, methods in tables.items():
        for name, other in methods.items():
            for outcome in ("safe", "success", "both") if name != _OWN else ():
                if outcome in other:
                    pair = _flags(methods[_OWN], outcome), _flags(other, outcome)
                    more, fewer, p = mcnemar_exact(*pair)
                    whole = sign_flip_exact(*pair, directions)
                    rows.append(
                        {
                            "question": question,
                            "against": name,
                            "outcome": outcome,
                            "only_safedpa": more,
                            "only_other": fewer,
                            "mcnemar": p,
                            "directions": whole,
                        }
                    )
    for test in ("mcnemar", "directions"):
        for row, p in zip(rows, holm([row[test] for row in rows]), strict=True):
            row[f"{test}_holm"] = p
    return rows


def _flags(row: Mapping[str, Any], outcome: str) -> Any:
    """(episodes,) from the strings of the result."""
    if outcome == "both":
        return _flags(row, "safe") & _flags(row, "success")
    return np.array([one == "1" for one in row[f"{outcome}_each"]])
