"""Sense to act over Zenoh: the real loop in its own processes, next to a bare chain of as many processes."""

from __future__ import annotations

import itertools
import json
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from safedpa.bus import ZenohSettings, ZenohTransport
from safedpa.bus.transport.ports import free_port
from safedpa.errors import SafedpaError
from safedpa_lab.benchmarks.usage import output_of
from safedpa_services.supervisor.child import Child

_HOPS = ("state", "latent", "nominal", "action")
_PAYLOAD = bytes(600)
"""As large as a state message with six obstacles."""
_START_SECONDS = 20.0
_LONGEST_BARE_SECONDS = 120.0
"""Of the bare chain, half before the loop and half after it: what else the machine does is then in both."""


def latency_benchmark(seconds: float, rate: float) -> dict[str, Any]:
    """Microseconds from sense to act of the real loop, and of the bare chain before and after it in the same run."""
    half = 0.5 * min(seconds, _LONGEST_BARE_SECONDS)
    before = bare_times(half, rate)
    loop = real_loop(seconds, rate)
    bare = _account([*before, *bare_times(half, rate)], 2 * round(half * rate), rate)
    return {
        "rate_hz": rate,
        "seconds": seconds,
        "bare_chain_us": bare,
        "real_loop_us": loop,
        "ratio_p50": round(loop["p50"] / bare["p50"], 2),
        "ratio_p99": round(loop["p99"] / bare["p99"], 2),
    }


def real_loop(seconds: float, rate: float, *, watched: bool = False) -> dict[str, float]:
    """What the robot of ``safedpa up`` measures, in real time with every service in its own process.

    The recorder and the diagnosis run next to it; where it is ``watched``, the dashboard and the workbench do too.
    """
    with tempfile.TemporaryDirectory() as folder:
        options = ["--seconds", repr(seconds), "--rate", repr(rate), "--load", "box", "--out", folder]
        summary = json.loads(output_of("up", "--json", *([] if watched else ["--headless"]), *options))
        if watched:
            _check_watched(summary)
        return {**summary["latency_us"], "watchdog_ticks": summary["watchdog_ticks"]}


def _check_watched(summary: dict[str, Any]) -> None:
    """Raises SafedpaError where someone who should have watched was not there."""
    there = {service["name"] for service in summary["services"]}
    absent = [name for name in ("dashboard", "diagnosis", "recorder", "workbench") if name not in there]
    if absent:
        raise SafedpaError(f"safedpa up: ran without {', '.join(absent)}; pip install 'safedpa[view,workbench]'")


def bare_chain(seconds: float, rate: float) -> dict[str, float]:
    """The same number of processes and hops, handing on the same number of bytes."""
    return _account(bare_times(seconds, rate), round(seconds * rate), rate)


def _account(times: list[float], sent: int, rate: float) -> dict[str, float]:
    """Percentiles of ``times`` [us], and the share of the ``sent`` that took longer than a period or were lost.

    Raises SafedpaError where none arrived.
    """
    if not times:
        raise SafedpaError(f"bare chain: got none of {sent} messages, wanted one at least; measure for longer")
    found = np.percentile(times, [50.0, 99.0, 99.9])
    in_time = sum(value <= 1e6 / rate for value in times)
    percentiles = {name: round(float(value), 1) for name, value in zip(("p50", "p99", "p999"), found, strict=True)}
    return {**percentiles, "late_share": 1.0 - in_time / sent}


def bare_times(seconds: float, rate: float) -> list[float]:
    """Microseconds from the first to the last of four hops through three processes, of each of ``rate`` a second."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    arrived = threading.Event()
    transport = ZenohTransport(ZenohSettings(listen=(endpoint,)))
    transport.subscribe(f"bare/{_HOPS[-1]}", lambda _key, _payload: arrived.set())
    microseconds = []
    with _relays(endpoint) as relays:
        _await(transport, len(relays), arrived)
        for _ in range(round(seconds * rate)):
            started = time.perf_counter()
            arrived.clear()
            transport.put(f"bare/{_HOPS[0]}", _PAYLOAD, never_drop=False)
            if arrived.wait(1.0):
                microseconds.append(1e6 * (time.perf_counter() - started))
            time.sleep(max(0.0, 1.0 / rate - (time.perf_counter() - started)))
    transport.close()
    return microseconds


@contextmanager
def _relays(endpoint: str) -> Iterator[list[Child]]:
    with tempfile.TemporaryDirectory() as folder:
        relays = []
        for source, target in itertools.pairwise(_HOPS):
            keys = ("--source", f"bare/{source}", "--target", f"bare/{target}", "--alive", f"bare/alive/{target}")
            options = ("--realtime", "--connect", endpoint, *keys)
            relays.append(Child(target, "safedpa_lab.benchmarks.bare_relay", options, Path(folder) / f"{target}.log"))
        try:
            for relay in relays:
                relay.start()
            yield relays
        finally:
            for relay in relays:
                relay.end(2.0)


def _await(transport: ZenohTransport, count: int, arrived: threading.Event) -> None:
    deadline = time.monotonic() + _START_SECONDS
    while len(transport.alive("bare/alive/*")) < count or not arrived.is_set():
        transport.put(f"bare/{_HOPS[0]}", _PAYLOAD, never_drop=False)
        arrived.wait(0.1)
        if time.monotonic() > deadline:
            raise SafedpaError(f"the bare chain did not start within {_START_SECONDS:.0f} s")
