"""Scripted drives: what experiments count in them is known."""

from collections.abc import Iterator, Sequence
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest


def robot(touched: int = 0, goals: int = 0, **more: Any) -> Any:
    """A robot that has touched and reached so much."""
    usual = {"values": (0.0,) * 4, "trajectory_hash": "t", "tick": 0, "changed_at": None}
    return SimpleNamespace(collisions=["a wall"] * touched, goals_reached=goals, **{**usual, **more})


def tick(status: str = "passed", h: float = 1.0, **values: Any) -> Any:
    """One period; ``x``, ``speed``, ``nominal`` and ``action`` as they are given."""
    x, speed, number = values.get("x", 0.0), values.get("speed", 0.0), values.get("number", 0)
    place = values.get("place", (x, 0.0))
    state = SimpleNamespace(robot_time=values.get("period", 0.05) * number, tick=number, values=(*place, 0.0, speed))
    verdict = SimpleNamespace(
        status=status, h_now=h, microseconds=100.0, predicted=(), nominal=values.get("nominal", ()),
        action=values.get("action", (0.0, 0.0)), stationary_reason="", sentence="",
    )  # fmt: skip
    return SimpleNamespace(verdict=verdict, state=state)


STORY: Sequence[Any] = [
    tick(status, h, number=number, x=0.1 * number, speed=-1.0)
    for number, (status, h) in enumerate([("passed", 0.5), ("corrected", 0.25), ("passed", -0.125), ("fallback", 0.75)])
]
"""Four periods of 50 ms, backwards at 1 m/s."""
STATUSES = {"passed": 2, "corrected": 1, "fallback": 1}


def follow(patch: pytest.MonkeyPatch, module: ModuleType, own: Any, story: Sequence[Any] = STORY, **robots: Any):
    """Makes an experiment drive ``own`` by the story, in as many periods as the story has.

    ``robots`` are names of what builds a robot in the module; by default ``CarRobot``.
    """

    def driven(_robot: Any, _nodes: Any, periods: int, **_: Any) -> Iterator[Any]:
        assert periods == len(story)
        yield from story

    patch.setattr(module, "drive", driven)
    for name in robots or {"CarRobot": None}:
        patch.setattr(module, name, lambda *_, **__: own, raising=False)
