"""Every row of the benchmark, one module each with a function ``measure(effort) -> Row``."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Final, NamedTuple

from safedpa_lab.benchmarks.results import Effort, Row

__all__ = ["ROWS", "Listed", "measured"]


class Listed(NamedTuple):
    """A row before it is measured."""

    work: str
    minutes: float
    """About, on two cores; 0 for less than half a minute."""
    long: bool = False
    """Left out unless it is named, or everything is asked for in full."""


ROWS: Final = {
    "kernel": Listed("everything that compiled decisions are to reach", 8.0, long=True),
    "filter": Listed("one decision of the safety filter", 9.0),
    "decision-parts": Listed("where the time of one decision goes", 0.8),
    "own-models": Listed("one decision with a user's own model and RolloutBarrier", 5.0),
    "sensed": Listed("one decision among what a laser sees, and from a scan to an action", 1.0),
    "adaptation": Listed("one step of the learned adaptation", 0.2),
    "batch": Listed("many robots through adaptation, policy and filter in one process", 1.0),
    "sense-to-act": Listed("sense to act over Zenoh, at 20 and 200 Hz, and watched", 2.0),
    "largest-fleet": Listed("the largest fleet at 20 Hz", 12.0, long=True),
    "car-steps": Listed("simulated car steps for training", 0.3),
    "point-steps": Listed("steps of the point robot", 0.3),
    "training": Listed("training data and phase 1a", 1.0),
    "reading": Listed("reading of logs in a process of its own", 3.0),
    "diagnosis": Listed("diagnosis of 6 runs of 40 s", 3.0),
    "long-logs": Listed("diagnosis of ten hours at 100 Hz", 15.0, long=True),
    "start": Listed("start to the first tick and page, a comparison, imports, memory", 2.0),
    "weights": Listed("training of all weights", 30.0, long=True),
}


def measured(name: str, effort: Effort) -> Row:
    """Measures one of ``ROWS``."""
    module = importlib.import_module(f"safedpa_lab.benchmarks.rows.{name.replace('-', '_')}")
    measure: Callable[[Effort], Row] = module.measure
    return measure(effort)
