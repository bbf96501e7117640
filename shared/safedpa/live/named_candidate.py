"""Which entry of a search's report is meant by the name of an effect."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from math import inf, isnan
from typing import Any

__all__ = ["named_candidate"]


def named_candidate(candidates: Iterable[Mapping[str, Any]], effect: str) -> Mapping[str, Any] | None:
    """Of a report's ``candidates`` the one that an effect's name stands for; None where there is none.

    As it is and under a condition (below a speed, in a place) an effect is tried under one name. Of the first stage's
    entries of that name it is the accepted one, else the one with the least error on unseen data; one that was not
    tried on them has no error and comes last.
    """
    own = [item for item in candidates if item.get("stage", 0) == 0 and item["effect"] == effect]
    return min(own, key=_place, default=None)


def _place(item: Mapping[str, Any]) -> tuple[bool, bool, float]:
    """Sorts the accepted one first, then by error; NaN, which is neither before nor after a number, as none."""
    reported = item.get("heldout_error")
    error = inf if reported is None or isnan(reported) else float(reported)
    return item.get("decision") != "accepted", error == inf, error
