"""Sense to act over Zenoh with every service its own process, beside a bare chain of as many processes."""

from __future__ import annotations

from safedpa_lab.benchmarks.latency import latency_benchmark
from safedpa_lab.benchmarks.results import Effort, Entry, Row, Target

__all__ = ["measure"]


def measure(effort: Effort) -> Row:
    """At 20 and 200 ticks a second; ten minutes of the slower one where everything is asked for in full."""
    ours, peers, targets = [], [], []
    for rate in effort.of((20.0,), (20.0, 200.0)):
        seconds = effort.of(2.0, 20.0, 600.0 if rate == 20.0 else 60.0)
        found = latency_benchmark(seconds, rate)
        loop, bare, at = found["real_loop_us"], found["bare_chain_us"], f"{rate:g} Hz"
        late = int(loop["watchdog_ticks"])
        figures = {name: float(value) for name, value in loop.items() if name != "watchdog_ticks"}
        note = f"adaptation, policy, filter and robot, a process each, {seconds:g} s at {at}: {late} late ticks"
        ours.append(Entry("safedpa", figures, problem=at, note=note, more={"late_ticks": late, "seconds": seconds}))
        passed_on = {name: float(value) for name, value in bare.items()}
        peers.append(Entry("bare Zenoh chain", passed_on, problem=at, note="hands 600 bytes on, computes nothing"))
        targets += [
            Target(f"p50 at {at}", 1500.0, figures["p50"], "us"),
            Target(f"p99 at {at}", 2500.0, figures["p99"], "us"),
            Target(f"late ticks at {at} in {seconds:g} s", 0.0, float(late), ""),
        ]
    work = "from sensing to the action's arrival, over Zenoh, every service its own process"
    notes = (
        "the bare chain is no peer but the floor: its ratio says which part of the time is the network's",
        "the bare chain hands on four times, the loop three times: its policy takes the latent of the tick before",
    )
    return Row("sense-to-act", work, "p50", tuple(ours), tuple(peers), tuple(targets), notes=notes)
