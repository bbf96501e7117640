"""A fleet in real time to which someone offers models that take long: late ticks next to those of the times between."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from safedpa_lab.benchmarks.reference import held_up_seconds

MOST_REFUSAL_SECONDS = 0.010
"""Between the action of a tick, behind which offers are looked at, and the refusal in the same tick."""
MACHINE_SHARE = 0.5
"""Of a robot's period: where a core did not run even its reference loop for so long within the period of a late tick,
that tick is the machine's. What is left is too little, and no message can do that to a loop that stands above all."""
Window = Sequence[float]
"""Begin and end, monotonic, s."""
Moments = Mapping[str, Any]
"""Of a fleet: ``counted`` (a window), ``late`` (when ticks were late, of which robot, which), ``acted`` (when actions
came, and so long after their states); monotonic, s."""
_STAGES = ("state", "latent", "nominal", "action")
_MOST_REPORTED = 100


def account_of_offers(
    file: Path, moments: Moments, rate_hz: float, references: Sequence[Path] = (), period: float = 0.05
) -> dict[str, Any]:
    """What the attacker saw while the fleet counted, joined with what the fleet says of the same moments.

    ``rate_hz``: robot-ticks a second of the whole fleet, by which those of each stretch of time are reckoned;
    ``references``: what loops saw that only keep time, one on each core; ``period``: of a robot, s.
    """
    begin, end = moments["counted"]
    found = json.loads(file.read_text(encoding="utf-8"))
    gaps = [json.loads(path.read_text(encoding="utf-8"))["gaps"] for path in references]
    windows = [(max(low, begin), min(high, end)) for low, high in found["windows"] if high > begin and low < end]
    attacked = sum(high - low for low, high in windows)
    late = [_late(entry, windows, gaps, period, found.get("chains", {})) for entry in moments["late"]]
    by_offer: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for refusal in found["refusals"]:
        by_offer[refusal["offer"]].append(refusal)
    delays = {True: [], False: []}  # type: dict[bool, list[float]]
    for at, delay in moments["acted"]:
        delays[_inside(at, windows)].append(delay)
    return {
        "offers": found["offers"],
        "under_attack": _stretch(attacked, [one for one in late if one["attacked"]], rate_hz, delays[True]),
        "in_peace": _stretch(
            end - begin - attacked, [one for one in late if not one["attacked"]], rate_hz, delays[False]
        ),
        "late": late[:_MOST_REPORTED],
        "answers": {name: _answers(answers) for name, answers in by_offer.items()},
    }


def _late(
    entry: Sequence[Any],
    windows: Sequence[Window],
    gaps: Sequence[Sequence[Window]],
    period: float,
    chains: Mapping[str, Mapping[str, float]],
) -> dict[str, Any]:
    """One late tick: what the machine did in its period, and when each message of it was seen, ms after its state."""
    at, robot, tick = entry
    held_up = max((held_up_seconds(core, at - period, at) for core in gaps), default=0.0)
    chain = chains.get(f"{robot} {tick}", {})
    return {
        "at": round(at, 4),
        "robot": robot,
        "tick": tick,
        "attacked": _inside(at, windows),
        "machine_held_up_ms": round(1e3 * held_up, 2),
        "machines": held_up >= MACHINE_SHARE * period,
        "seen_ms": {
            stage: round(1e3 * (chain[stage] - chain["state"]), 2)
            for stage in _STAGES
            if stage in chain and "state" in chain
        },
    }


def _inside(at: float, windows: Iterable[Window]) -> bool:
    return any(low <= at <= high for low, high in windows)


def _stretch(
    seconds: float, late: Sequence[Mapping[str, Any]], rate_hz: float, delays: Sequence[float]
) -> dict[str, Any]:
    ticks = round(seconds * rate_hz)
    return {
        "seconds": round(seconds, 1),
        "robot_ticks": ticks,
        "late_ticks": len(late),
        "late_by_the_machine": sum(one["machines"] for one in late),
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
