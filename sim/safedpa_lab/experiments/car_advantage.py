"""Whether what SafeDPA gains or loses against each other method on the car is more than chance."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np

from safedpa.arrays import BoolArray
from safedpa_lab.experiments.car_episodes import Outcome
from safedpa_lab.experiments.car_methods import METHODS
from safedpa_lab.experiments.car_table import MEASURES
from safedpa_lab.experiments.paired import holm, mcnemar_exact

__all__ = ["OWN", "SIGNIFICANT", "advantage_entry", "advantages"]

OWN: Final = "safedpa"
"""Who is compared with every other method."""
SIGNIFICANT: Final = 0.05
"""Of a p by Holm's method."""

Outcomes = Mapping[str, Sequence[Outcome]]
"""By method, of the same scenes in the same order."""


def advantages(places: Mapping[str, Outcomes], measures: Sequence[str] = tuple(MEASURES)) -> list[dict[str, Any]]:
    """SafeDPA against every other method in each place, by measure: a row each; none where SafeDPA is not driven.

    ``places`` by name, such as a configuration or a value. Episodes are paired by scene: ``only_safedpa`` are those
    that went well with it alone, ``only_other`` those that did with the other alone, ``mcnemar`` the exact two-sided p
    of their being as many, ``holm`` the same as it stands next to all rows.
    """
    rows = [row for place, outcomes in places.items() for row in _rows(place, outcomes, measures)]
    for row, p in zip(rows, holm([row["mcnemar"] for row in rows]), strict=True):
        row["holm"] = p
    return rows


def _rows(place: str, outcomes: Outcomes, measures: Sequence[str]) -> Iterator[dict[str, Any]]:
    if OWN not in outcomes:
        return
    for name, other in outcomes.items():
        for measure in measures if name != OWN else ():
            more, fewer, p = mcnemar_exact(_flags(outcomes[OWN], measure), _flags(other, measure))
            reported = {"place": place, "against": name, "title": METHODS[name].title, "measure": measure}
            yield {**reported, "episodes": len(other), "only_safedpa": more, "only_other": fewer, "mcnemar": p}


def _flags(outcomes: Sequence[Outcome], measure: str) -> BoolArray:
    """(episodes,) whether each went well."""
    return np.array([_went_well(item, measure) for item in outcomes], dtype=bool)


def _went_well(item: Outcome, measure: str) -> bool:
    return {"success": item.success, "safe": item.safe, "both": item.success and item.safe}[measure]


def advantage_entry(row: Mapping[str, Any]) -> str:
    """A row as it stands in a table: episodes that went well with SafeDPA alone, with the other alone, and Holm's p.

    Bold where the p is below ``SIGNIFICANT``; a minus where neither ever went well alone.
    """
    more, fewer, p = row["only_safedpa"], row["only_other"], row["holm"]
    if not more + fewer:
        return "-"
    reported = f"{more} : {fewer}, p = {p:.2g}"
    return f"**{reported}**" if p < SIGNIFICANT else reported
