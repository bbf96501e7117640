"""Decisions with models of a user's own behind a ``RolloutBarrier``, compiled to C and in NumPy, in turn in one run."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Final

from safedpa.errors import SafedpaError
from safedpa.safety import SafetyFilter
from safedpa_lab.benchmarks.results import Effort, Entry, Row, Target, microseconds
from safedpa_lab.benchmarks.timing import in_turn
from safedpa_lab.benchmarks.users_models import ROBOTS, UsersRobot

_SEED: Final = 4811
_REQUESTS: Final = 300
_MOST: Final = 2000.0
"""us of a decision at the 99th percentile, as asked for."""
_COMPILE: Final = 3.0
"""s of a compilation without a cache, as asked for."""


def measure(effort: Effort) -> Row:
    """Decisions under extreme nominal actions on the same states; and what a compilation without a cache takes."""
    calls, seconds = effort.of((40, 10.0), (3000, 300.0))
    ours, targets = list[Entry](), list[Target]()
    for name, robot in ROBOTS.items():
        asked = robot.requests(effort.of(40, _REQUESTS), _SEED)
        compiled, cold = made_cold(name, robot)
        with _environment("SAFEDPA_COMPILE", "0"):
            plain, _, _ = robot.made()
        both: dict[str, tuple[Callable[[Any], Any], Sequence[Any]]] = {
            "compiled": (compiled, asked),
            "NumPy": (_deciding(plain), asked),
        }
        times = in_turn(both, calls, seconds / len(ROBOTS))
        ours += [microseconds(f"safedpa, {how}", found, name) for how, found in times.items()]
        targets.append(Target(f"p99, {name}", _MOST, times["compiled"]["wall"]["p99"], "us"))
        targets.append(Target(f"compiled without a cache, {name}", _COMPILE, cold, "s"))
    work = "one decision with a user's own model and RolloutBarrier"
    return Row("own-models", work, "p99", tuple(ours), targets=tuple(targets))


def made_cold(name: str, robot: UsersRobot) -> tuple[Callable[[Any], Any], float]:
    """What decides about a robot's requests, compiled without a cache, and the seconds that this took.

    Raises SafedpaError where it is not compiled.
    """
    with _environment("XDG_CACHE_HOME", tempfile.mkdtemp(prefix="safedpa-kernels-")):
        began = time.perf_counter()
        compiled, barrier, _ = robot.made()
        cold = time.perf_counter() - began
    if barrier.not_compiled:
        raise SafedpaError(f"{name}: not compiled: {barrier.not_compiled}")
    return _deciding(compiled), cold


def _deciding(safe: SafetyFilter) -> Callable[[Any], Any]:
    return lambda request: safe.decide(*request)


@contextmanager
def _environment(name: str, value: str) -> Iterator[None]:
    before = os.environ.get(name)
    os.environ[name] = value
    try:
        yield
    finally:
        del os.environ[name]
        if before is not None:
            os.environ[name] = before
