"""``python -m safedpa_lab.benchmarks.reference``: a loop that does nothing but wake up in time, on one core.

It stands before everything else of ours, so that only the machine itself can hold it up: its kernel, or anyone who
shares the processor with it from outside. Ticks that are late at the same moment are not the fault of those who were
to answer them. The kernel also holds it up where real-time processes took more than 95 % of a second of its core.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import time
from collections.abc import Iterable, Sequence
from itertools import count
from pathlib import Path

from safedpa.bus.service.process import RealtimePriority, StopSignal, run_process

_PERIOD_SECONDS = 0.005
_LATE_SECONDS = 0.002
_CACHED = 100_000


def held_up_seconds(gaps: Iterable[Sequence[float]], begin: float, end: float) -> float:
    """s between two moments in which a core did not run its reference; each gap is (due, woke), monotonic, s."""
    return sum(max(0.0, min(woke, end) - max(due, begin)) for due, woke in gaps)


def work(options: argparse.Namespace, stop: StopSignal) -> int:
    """Notes when it woke up too late, until ``stop``; writes the account; returns exit code 0."""
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setaffinity(0, {options.core})
    if options.realtime:
        with contextlib.suppress(OSError, AttributeError):
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(max(RealtimePriority) + 1))
    gaps: list[tuple[float, float]] = []
    due = time.monotonic()
    for turns in count():
        if stop():
            break
        due += _PERIOD_SECONDS
        time.sleep(max(0.0, due - time.monotonic()))
        woke = time.monotonic()
        if woke - due > _LATE_SECONDS and turns and len(gaps) < _CACHED:
            gaps.append((due, woke))
        due = max(due, woke - _PERIOD_SECONDS)
    options.account.write_text(json.dumps({"core": options.core, "gaps": gaps}), encoding="utf-8")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="safedpa-reference")
    parser.add_argument("--core", type=int, required=True, help="on which it stays")
    parser.add_argument("--account", type=Path, required=True)
    return parser


if __name__ == "__main__":
    run_process(work, _parser())
