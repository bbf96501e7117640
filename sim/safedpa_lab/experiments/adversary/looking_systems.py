"""The systems whose plain barrier looks too near, with barriers that look as far as they need; and a thin obstacle."""

from __future__ import annotations

from typing import Any

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.safety import FunctionBarrier, HigherOrderBarrier, PendingActions, RolloutBarrier
from safedpa.safety.barriers.base import AbstractBarrier
from safedpa_lab.experiments.adversary.control_system import PERIOD, ControlSystem
from safedpa_lab.experiments.adversary.line_systems import late_drive, room_before_the_wall
from safedpa_lab.experiments.adversary.plane_systems import disc_of_degree_two

__all__ = ["disc_by_higher_order", "disc_by_rollout", "late_by_pending_actions", "thin_disc"]


_RADIUS = 0.1
"""m of the thin disc: one passes it by 0.5 m in a tick."""
_FAST = 10.0
"""m/s."""


def late_by_pending_actions() -> ControlSystem:
    """The mass before a wall with three actions on their way, as ``PendingActions`` wraps the model without delay."""
    prompt, step = late_drive(looking_ahead=False), 0.5 * PERIOD**2

    def affine(x: FloatArray) -> Any:
        return np.array([x[0] + PERIOD * x[1], x[1]]), np.array([[step], [PERIOD]])

    late = PendingActions(affine, 3, resting=(0.0,))
    wall = FunctionBarrier(lambda x: float(room_before_the_wall(x[None])[0, 0]), names=("wall",))
    return _given(prompt, "delay, PendingActions", [late.barrier(wall)])


def disc_by_rollout() -> ControlSystem:
    """The mass before a disc, by a manoeuvre that brakes."""
    plain = disc_of_degree_two()

    def affine(x: FloatArray) -> Any:
        return plain.f(x), plain.g(x)

    def braking(x: FloatArray) -> FloatArray:
        return np.clip(-20.0 * x[2:], -1.0, 1.0)

    part = RolloutBarrier(affine, braking, lambda x: float(plain.h(x[None])[0, 0]), horizon=100)
    return _given(plain, "relative degree two, RolloutBarrier", [part])


def disc_by_higher_order() -> ControlSystem:
    """The mass before a disc, by the derivative of the distance and what a brake of 0.5 m/s2 allows at any distance."""
    plain = disc_of_degree_two()

    def distance(x: FloatArray) -> Any:
        return float(np.hypot(x[0], x[1]) - 0.5)

    def approach(x: FloatArray) -> Any:
        return float(x[:2] @ x[2:] / max(float(np.hypot(x[0], x[1])), 1e-9))

    def allowed(h: FloatArray) -> Any:
        return np.sqrt(np.maximum(h, 0.0))

    part = HigherOrderBarrier((distance, approach), (allowed,))
    return _given(plain, "relative degree two, HigherOrderBarrier", [part])


def thin_disc(*, between_ticks: bool) -> ControlSystem:
    """(x, y [m]) at up to 10 m/s on each axis, a disc of 0.1 m: h is judged at the ticks, or between them too."""

    def affine(x: FloatArray) -> Any:
        return x.copy(), PERIOD * np.eye(2)

    def h(x: FloatArray) -> FloatArray:
        return np.asarray(np.hypot(x[:, 0], x[:, 1])[:, None] - _RADIUS)

    def swept(x: FloatArray, reached: FloatArray) -> float:
        way = reached - x
        share = np.clip(-float(x @ way) / max(float(way @ way), 1e-300), 0.0, 1.0)
        return float(np.hypot(*(x + share * way)) - _RADIUS)

    def barriers() -> list[AbstractBarrier]:
        return [RolloutBarrier(affine, (0.0, 0.0), lambda x: float(h(x[None])[0, 0]), horizon=1)]

    return ControlSystem(
        name="thin obstacle, RolloutBarrier" if between_ticks else "thin obstacle, judged at the ticks",
        f=lambda x: x.copy(),
        g=lambda _: PERIOD * np.eye(2),
        h=h,
        start=lambda random: random.uniform(-2.0, 2.0, 2),
        low=(-_FAST, -_FAST),
        high=(_FAST, _FAST),
        backup=lambda _: [0.0, 0.0],
        margin=0.002,
        barriers=barriers if between_ticks else None,
        invariant=between_ticks,
        swept=swept,
    )


def _given(plain: ControlSystem, name: str, parts: list[AbstractBarrier]) -> ControlSystem:
    """The same system with other barriers, which promise that h stays positive."""
    return ControlSystem(
        name=name,
        f=plain.f,
        g=plain.g,
        h=plain.h,
        start=plain.start,
        low=plain.low,
        high=plain.high,
        backup=plain.backup,
        margin=plain.margin,
        barriers=lambda: parts,
    )
