"""What diagnosis has to show on real recordings, and whether it does."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

__all__ = ["folds_target", "targets_of"]

_SLOW = ("torque_lag", "torque_delay", "torque_offset")
"""Which the pendulum's own authors, and fits elsewhere, leave out."""


def targets_of(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Each target with what was asked, what was measured and whether it was met; only of recordings that are there."""
    found = []
    for row in rows:
        if row["part"] == "car":
            found.append(_car(row))
            if row.get("unseen_where_told"):
                found.append(_car_where_reported(row))
        elif row["part"] == "pendulum":
            found += _pendulum(row)
        elif (wanted := _ball(row)) is not None:
            found.append(wanted)
    return found


def _target(subject: str, asked: str, measured: str, met: bool) -> dict[str, Any]:
    return {"subject": subject, "asked": asked, "measured": measured, "met": met}


def _car(row: dict[str, Any]) -> dict[str, Any]:
    count = len(row["added"])
    if not row["name"]:
        measured = f"{100 * row['change']:+.1f} % with {count} effects"
        return _target("car, all logs", "held-out error at least -60 %", measured, row["change"] <= -0.60)
    measured = f"{100 * row['unseen_change']:+.1f} % with {count} effects"
    log = row["name"].removesuffix(".csv")[-8:]  # the names differ in the time of day
    undecided = row["verdict"] == "undecided"
    met = undecided or row["unseen_change"] <= -0.30
    return _target(
        f"car, without {log}",
        "error on that log at least -30 %, or undecided",
        "undecided" if undecided else measured,
        met,
    )


def _car_where_reported(row: dict[str, Any]) -> dict[str, Any]:
    """Of the part of a log that the diagnosis of the others says it holds for, in its first sentence."""
    log, reported, errors = row["name"].removesuffix(".csv")[-8:], row["unseen_told"], row["unseen_where_told"]
    change = errors[1] / errors[0] - 1.0
    measured = f"{100 * change:+.1f} %; {100 * reported:.0f} % of its predictions lie there"
    return _target(f"car, without {log}, where told", "-30 % where it says that it holds", measured, change <= -0.30)


def folds_target(change: float) -> dict[str, Any]:
    """Of the errors on the logs that were left out, added up."""
    return _target(
        "car, all four left out in turn", "errors together at least -60 %", f"{100 * change:+.1f} %", change <= -0.60
    )


def _pendulum(row: dict[str, Any]) -> list[dict[str, Any]]:
    first = row["added"][0] if row["added"] else "nothing"
    fall = row["errors"][1] / row["errors"][0] - 1.0 if row["added"] else 0.0
    late = [name for name in row["added"] if name in _SLOW]
    return [
        _target("pendulum", "Coulomb friction first", first, first == "coulomb_friction"),
        _target("pendulum", "which takes off at least 45 %", f"{100 * fall:+.1f} %", fall <= -0.45),
        _target("pendulum", "no lag, delay or offset", ", ".join(late) or "none", not late),
    ]


def _ball(row: dict[str, Any]) -> dict[str, Any] | None:
    name, added = row["name"].lower(), row["added"]
    if "bowling" in name:
        return _target(row["name"], "nothing missing", ", ".join(added) or row["verdict"], not added)
    if "whiffle" in name:
        notice = ", ".join(added) or row["verdict"]
        return _target(row["name"], "quadratic drag first", notice, added[:1] == ["quadratic_drag"])
    return None
