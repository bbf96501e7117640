"""``python -m safedpa_lab.benchmarks.hostile.flooding``: who has a role's key, and says as much as it can.

It writes down when it began and ended, by the machine's monotonic clock, and how much went out. Where its link is cut
off it goes on: the library makes a new one.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import time
from pathlib import Path

from safedpa.bus import ZenohTransport
from safedpa.bus.messages.topics import TOPICS, key_of
from safedpa.bus.service.process import StopSignal, add_bus_options, run_process, transport_settings_from_options
from safedpa.errors import BusError

_AT_A_TIME = 50
_PAUSE_SECONDS = 0.0005
"""After so many, for anyone who shares the processor with it."""


def work(options: argparse.Namespace, stop: StopSignal) -> int:
    """Floods for ``--seconds``, or until ``stop``; returns exit code 0."""
    topic = TOPICS[options.topic]
    key = key_of(options.fleet, options.robot, topic, options.role)
    payload = bytes(options.bytes)
    transport = ZenohTransport(transport_settings_from_options(options))
    began, sent = time.monotonic(), 0
    while not stop() and time.monotonic() - began < options.seconds:
        with contextlib.suppress(BusError):
            for _ in range(_AT_A_TIME):
                transport.put(key, payload, never_drop=topic.delivery == "all")
                sent += 1
        time.sleep(_PAUSE_SECONDS)
    account = {"began": began, "ended": time.monotonic(), "sent": sent, "bytes": sent * options.bytes}
    options.account.write_text(json.dumps(account), encoding="utf-8")
    transport.close()
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="safedpa-flooding")
    add_bus_options(parser)
    parser.add_argument("--robot", default="r1", help="about which robot")
    parser.add_argument("--topic", required=True, help="on which topic")
    parser.add_argument("--bytes", type=int, default=100, help="of each message")
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--account", type=Path, required=True)
    return parser


if __name__ == "__main__":
    run_process(work, _parser())
