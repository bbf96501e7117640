"""Finds the entry of a search report that belongs to the name of an effect."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from math import inf, isnan
from typing import Any

__all__ = ["named_candidate"]


def named_candidate(candidates: Iterable[Mapping[str, Any]], effect: str) -> Mapping[str, Any] | None:
    """Returns the entry of a report's ``candidates`` for an effect; None if there is none.

    An effect with and without a condition (below a speed, in a region) has the same name. Of the first stage's entries
    with that name this is the accepted one, otherwise the one with the lowest error on unseen data.
    """
    own = [item for item in candidates if item.get("stage", 0) == 0 and item["effect"] == effect]
    return min(own, key=_place, default=None)


def _place(item: Mapping[str, Any]) -> tuple[bool, bool, float]:
    """Sort key: accepted first, then by error."""
    # NaN is not ordered, so it counts as missing; entries that were not tried on unseen data have no error and come
    # last.
    reported = item.get("heldout_error")
    error = inf if reported is None or isnan(reported) else float(reported)
    return item.get("decision") != "accepted", error == inf, error
