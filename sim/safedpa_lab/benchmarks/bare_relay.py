"""``python -m safedpa_lab.benchmarks.bare_relay``: hands bytes on from one key to the next, and nothing else.

The reference for sense to act: as many processes and hops as the real loop, without any work in them.
"""

from __future__ import annotations

import argparse

from safedpa.bus import ZenohSettings, ZenohTransport
from safedpa.bus.service.process import RealtimePriority, StopSignal, run_process


def work(options: argparse.Namespace, stop: StopSignal) -> int:
    """Relays until ``stop``."""
    transport = ZenohTransport(ZenohSettings(connect=(options.connect,)))
    transport.subscribe(options.source, lambda _, payload: transport.put(options.target, payload, never_drop=False))
    transport.declare_alive(options.alive)
    stop.wait()
    transport.close()
    return 0


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="bare-relay")
    for name in ("--connect", "--source", "--target", "--alive"):
        parser.add_argument(name, required=True)
    run_process(work, parser, RealtimePriority.ROBOT)
