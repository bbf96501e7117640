"""Times of many calls: by the clock and of the processor, as percentiles. Needs nothing but Python and numpy."""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

PERCENTILES = {"p10": 10.0, "p50": 50.0, "p99": 99.0, "p999": 99.9}
_FEWEST = 20
"""Calls, however long one takes."""


def percentiles(microseconds: Sequence[float]) -> dict[str, float]:
    """p10, p50, p99, p99.9 and the longest."""
    import numpy as np

    found = np.percentile(microseconds, list(PERCENTILES.values()))
    shown = {name: round(float(value), 2) for name, value in zip(PERCENTILES, found, strict=True)}
    return {**shown, "longest": round(max(microseconds), 2)}


def timed(call: Callable[[Any], Any], inputs: Sequence[Any], count: int, seconds: float = 5.0) -> dict[str, Any]:
    """Microseconds of ``call(input)`` over ``inputs`` in turn: ``wall`` by the clock, ``processor`` of all threads.

    A tenth of the calls, and each input once, go before and are not counted. After ``seconds`` it ends with what it
    has. The garbage collection runs as it is: its overhead is part of the longest calls.
    """
    for index in range(max(count // 10, len(inputs))):
        call(inputs[index % len(inputs)])
    wall, processor = [], []
    deadline = time.perf_counter() + seconds
    for index in range(count):
        given = inputs[index % len(inputs)]
        used, began = time.process_time_ns(), time.perf_counter_ns()
        call(given)
        wall.append(1e-3 * (time.perf_counter_ns() - began))
        processor.append(1e-3 * (time.process_time_ns() - used))
        if index >= _FEWEST and time.perf_counter() > deadline:
            break
    return {"calls": len(wall), "wall": percentiles(wall), "processor": percentiles(processor)}


def in_turn(
    asked: Mapping[str, tuple[Callable[[Any], Any], Sequence[Any]]], count: int, seconds: float
) -> dict[str, dict[str, Any]]:
    """As ``timed`` of several calls, each with inputs of its own, one of each after the other: to be compared.

    Each turn has an order of its own, drawn from a fixed seed: what a call leaves in the caches helps no one for ever.
    """
    order, shuffled = list(asked), random.Random(0)
    wall: dict[str, list[float]] = {name: [] for name in asked}
    processor: dict[str, list[float]] = {name: [] for name in asked}
    deadline = float("inf")
    for index in range(-(count // 10), count):
        if index == 0:
            deadline = time.perf_counter() + seconds
        shuffled.shuffle(order)
        for name in order:
            call, inputs = asked[name]
            given = inputs[index % len(inputs)]
            used, began = time.process_time_ns(), time.perf_counter_ns()
            call(given)
            took, spent = time.perf_counter_ns() - began, time.process_time_ns() - used
            if index >= 0:
                wall[name].append(1e-3 * took)
                processor[name].append(1e-3 * spent)
        if index >= _FEWEST and time.perf_counter() > deadline:
            break
    return {
        name: {"calls": len(own), "wall": percentiles(own), "processor": percentiles(processor[name])}
        for name, own in wall.items()
    }


def rate(call: Callable[[], Any], units: float, seconds: float, least: int = 3, times: int = 1) -> dict[str, float]:
    """Units a second when one call does ``units`` of them: the best and the median turn, by the clock and processor.

    A turn is ``times`` calls.
    """

    def turn() -> None:
        for _ in range(times):
            call()

    turn()
    wall: list[float] = []
    processor: list[float] = []
    deadline = time.perf_counter() + seconds
    while len(wall) < least or time.perf_counter() < deadline:
        used, began = time.process_time(), time.perf_counter()
        turn()
        wall.append(time.perf_counter() - began)
        processor.append(time.process_time() - used)
    middle = sorted(wall)[len(wall) // 2], sorted(processor)[len(processor) // 2]
    return {
        "per_second": times * units / middle[0],
        "best_per_second": times * units / min(wall),
        "per_processor_second": times * units / max(middle[1], 1e-9),
    }
