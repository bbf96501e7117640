"""The fleet under hostile offers, as one result."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from safedpa_lab.benchmarks.fleet import LATE_SHARE, FleetTrial, fleet_benchmark
from safedpa_lab.benchmarks.hostile.offering import FREEZES
from safedpa_lab.benchmarks.hostile.offers import MOST_REFUSAL_SECONDS

_ROBOTS = 8
_STRETCH_SECONDS = 5.0


def offers_benchmark(
    seconds: float = 60.0, report_progress: Callable[[int, int], None] = lambda _done, _all: None, robots: int = _ROBOTS
) -> dict[str, Any]:
    """It holds when the offer that froze a machine is refused within 10 ms, next to what half of all ticks take from
    state to action in peace, and no more ticks are late than in peace, or than a fleet may have; those left out in
    whose period the machine did not run even a loop that only keeps time.

    Raises SafedpaError as the fleet does.
    """
    result = fleet_benchmark(FleetTrial(robots, seconds, realtime=True, offers=_STRETCH_SECONDS), report_progress)
    found = result["offers"]
    attack, peace, first = found["under_attack"], found["in_peace"], found["answers"].get(FREEZES, {})
    slowest, usual = (first.get("after_state_ms") or {}).get("most"), peace["sense_to_act_ms"]["p50"]
    late, usually = (stretch["late_ticks"] - stretch["late_by_the_machine"] for stretch in (attack, peace))
    held = (
        late <= max(usually, LATE_SHARE * attack["robot_ticks"])
        and slowest is not None
        and slowest - usual <= 1e3 * MOST_REFUSAL_SECONDS
    )
    return {**result, "held": held and first["refused"] == first["answers"] > 0 and result["collisions"] == 0}
