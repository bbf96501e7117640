"""``python -m safedpa_lab.benchmarks.flood``: a robot that floods the bus, next to those that are measured.

A thousand messages a second under a name of its own: states whose ticks race, garbage, NaN, and payloads of 60 KiB, in
turn, and a model that is none in every tenth.
"""

from __future__ import annotations

import argparse
import itertools
import struct
import time

import msgpack

from safedpa.bus.service.process import StopSignal, run_process
from safedpa.bus.transport.zenoh import ZenohSettings, ZenohTransport

_PAUSE_SECONDS = 0.01


def messages(tick: int) -> list[tuple[str, bytes, bool]]:
    """(topic, payload, whether it must not be dropped) of one tick."""
    state = {
        "epoch": 1, "tick": tick, "robot_time": 0.05 * tick, "publish_time": 0.0, "values": (0.0, 0.0, 0.0, 1.0),
        "applied": (0.0, 0.0), "applied_by": "filter", "period": 0.05, "lockstep": False, "goal": (1.0, 1.0),
        "obstacles": tuple((1.0 + 0.01 * index, 0.0, 0.2) for index in range(60)), "field": (-4.0, 4.0, -4.0, 4.0),
        "footprint": (0.08, 0.4, 0.12),
    }  # fmt: skip
    kinds = (
        ("state", msgpack.packb(state), False),
        ("state", struct.pack(">Id", tick, float("nan")), False),
        ("latent", bytes(60_000), False),
        ("nominal", msgpack.packb({**state, "values": (float("nan"), 0.0), "controller": "flood"}), False),
    )
    chosen = kinds[tick % len(kinds)]
    return [chosen, ("model", bytes(20_000), True)] if tick % 10 == 0 else [chosen]


def work(options: argparse.Namespace, stop: StopSignal) -> int:
    """Floods until ``stop``."""
    transport = ZenohTransport(ZenohSettings(connect=(options.connect,)))
    begin, ticks = time.monotonic(), itertools.count()
    sent = 0
    while not stop():
        while sent < options.rate * (time.monotonic() - begin):
            for topic, payload, never_drop in messages(next(ticks)):
                transport.put(f"safedpa/{options.fleet}/flood/{topic}", payload, never_drop=never_drop)
            sent += 1
        time.sleep(_PAUSE_SECONDS)
    transport.close()
    return 0


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="safedpa-flood")
    parser.add_argument("--connect", required=True)
    parser.add_argument("--fleet", default="fleet")
    parser.add_argument("--rate", type=float, default=1000.0, help="messages a second")
    run_process(work, parser)
