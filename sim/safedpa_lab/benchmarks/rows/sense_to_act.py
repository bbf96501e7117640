"""Sense to act over Zenoh with every service its own process, next to a bare chain of as many processes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from safedpa.errors import SafedpaError
from safedpa_lab.benchmarks.latency import latency_benchmark, real_loop
from safedpa_lab.benchmarks.results import Effort, Entry, Floor, Row, Target, missing

_TIMES: Final = 1.2
"""As long as the bare chain at its p99, at most: what the services may add."""
_WATCHED_RATE: Final = 20.0
_WATCHED: Final = "20 Hz, watched"
_WATCHERS: Final = "dashboard, diagnosis, recorder and workbench next to it"


def measure(effort: Effort) -> Row:
    """At 20 and 200 ticks a second, ten minutes of each where everything is asked for in full; then 20 Hz, watched."""
    ours, peers, targets = list[Entry](), list[Entry](), list[Target]()
    bare: dict[float, Mapping[str, float]] = {}
    for rate in effort.of((20.0,), (20.0, 200.0)):
        seconds = effort.of(2.0, 20.0, 600.0)
        found = latency_benchmark(seconds, rate)
        at = f"{rate:g} Hz"
        ours.append(_entry(found["real_loop_us"], at, rate, seconds))
        bare[rate] = found["bare_chain_us"]
        peers.append(_chain(bare[rate], at))
        targets += _targets(ours[-1], at, bare[rate])
    if not effort.quick:
        ours.append(_watched(effort.of(0.0, 20.0, 120.0)))
        targets += _targets(ours[-1], _WATCHED, bare[_WATCHED_RATE]) if ours[-1].figures else []
    work = "from sensing to the action's arrival, over Zenoh, every service its own process"
    notes = (
        "the bare chain is no peer but the floor: its ratio says which part of the time is the network's; it runs half "
        "before the loop and half after it",
        "the bare chain hands on four times, the loop three times: its policy takes the latent of the tick before",
        "the loop is recorded and diagnosed in every line; watched: with dashboard and workbench too",
    )
    return Row("sense-to-act", work, "p50", tuple(ours), tuple(peers), tuple(targets), notes=notes)


def _watched(seconds: float) -> Entry:
    """The loop while everything that ``safedpa up`` can start looks on."""
    try:
        loop = real_loop(seconds, _WATCHED_RATE, watched=True)
        return _entry(loop, _WATCHED, _WATCHED_RATE, seconds, f", {_WATCHERS}")
    except SafedpaError as error:
        return missing("safedpa", str(error), _WATCHED)


def _chain(bare: Mapping[str, float], at: str) -> Entry:
    late = bare["late_share"]
    note = f"hands 600 bytes on, computes nothing; {100.0 * late:.3g} % come later than a period, or not at all"
    figures = {name: float(value) for name, value in bare.items() if name != "late_share"}
    return Entry("bare Zenoh chain", figures, problem=at, note=note, more={"late_share": late})


def _entry(loop: Mapping[str, Any], at: str, rate: float, seconds: float, alongside: str = "") -> Entry:
    late = int(loop["watchdog_ticks"])
    figures = {name: float(value) for name, value in loop.items() if name != "watchdog_ticks"}
    what = f"adaptation, policy, filter and robot, a process each{alongside}"
    note = f"{what}, {seconds:g} s at {rate:g} Hz: {late} late ticks"
    more = {"late_ticks": late, "seconds": seconds, "ticks": round(seconds * rate)}
    return Entry("safedpa", figures, problem=at, note=note, more=more)


def _targets(entry: Entry, at: str, bare: Mapping[str, float]) -> list[Target]:
    what = f"p99 at {at}, {_TIMES:g} times the bare chain's"
    late, seconds = float(entry.more["late_ticks"]), entry.more["seconds"]
    wanted, floor = round(_TIMES * bare["p99"], 1), Floor("the bare chain", bare["p99"])
    as_late = Floor("as late as the bare chain", round(bare["late_share"] * entry.more["ticks"]))
    return [
        Target(what, wanted, entry.figures["p99"], "us", floor=floor),
        Target(f"late ticks at {at} in {seconds:g} s", 0.0, late, "", floor=as_late),
    ]
