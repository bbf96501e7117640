"""A fleet in real time to which somebody offers models that take long: late ticks beside those of the times between."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

__all__ = ["MOST_REFUSAL_SECONDS", "account_of_offers"]

MOST_REFUSAL_SECONDS = 0.010
"""Between the action of a tick, behind which offers are looked at, and the refusal in the same tick."""
Window = Sequence[float]
"""Begin and end, monotonic, s."""
Moments = Mapping[str, Any]
"""Of a fleet: ``counted`` (a window), ``late_at`` (when ticks were late), ``acted`` (when actions came, and so long
after their states); monotonic, s."""


def account_of_offers(file: Path, moments: Moments, rate_hz: float) -> dict[str, Any]:
    """What the attacker saw while the fleet counted, joined with what the fleet says of the same moments.

    ``rate_hz``: robot-ticks a second of the whole fleet, by which those of each stretch of time are reckoned.
    """
    begin, end = moments["counted"]
    found = json.loads(file.read_text(encoding="utf-8"))
    windows = [(max(low, begin), min(high, end)) for low, high in found["windows"] if high > begin and low < end]
    attacked = sum(high - low for low, high in windows)
    late = moments["late_at"]
    under = sum(_inside(at, windows) for at in late)
    by_offer: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for refusal in found["refusals"]:
        by_offer[refusal["offer"]].append(refusal)
    delays = {True: [], False: []}  # type: dict[bool, list[float]]
    for at, delay in moments["acted"]:
        delays[_inside(at, windows)].append(delay)
    return {
        "offers": found["offers"],
        "under_attack": _stretch(attacked, under, rate_hz, delays[True]),
        "in_peace": _stretch(end - begin - attacked, len(late) - under, rate_hz, delays[False]),
        "answers": {name: _answers(answers) for name, answers in by_offer.items()},
    }


def _inside(at: float, windows: Iterable[Window]) -> bool:
    return any(low <= at <= high for low, high in windows)


def _stretch(seconds: float, late: int, rate_hz: float, delays: Sequence[float]) -> dict[str, Any]:
    ticks = round(seconds * rate_hz)
    return {
        "seconds": round(seconds, 1),
        "robot_ticks": ticks,
        "late_ticks": late,
        "sense_to_act_ms": {"p50": _share(delays, 0.5), "p99": _share(delays, 0.99), "most": _share(delays, 1.0)},
    }


def _answers(answers: Sequence[dict[str, Any]]) -> dict[str, Any]:
    waits = [answer["after_state_seconds"] for answer in answers if answer["after_state_seconds"] is not None]
    return {
        "answers": len(answers),
        "refused": sum(answer["state"] == "refused" for answer in answers),
        "reason": answers[-1]["reason"],
        "after_state_ms": {"p50": _share(waits, 0.5), "p99": _share(waits, 0.99), "most": _share(waits, 1.0)},
        "after_offer_ms": {"p50": _share([answer["seconds"] for answer in answers], 0.5)},
    }


def _share(values: Sequence[float], share: float) -> float | None:
    """ms; the smallest of the values that ``share`` of them do not exceed; None of none."""
    ordered = sorted(values)
    return round(1e3 * ordered[min(len(ordered) - 1, int(share * len(ordered)))], 2) if ordered else None
