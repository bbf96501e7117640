"""Small control-affine systems on a line and in a plane, with barriers, for the attack ``systems``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.safety import (
    FilterSettings,
    FunctionBarrier,
    HigherOrderBarrier,
    PendingActions,
    RolloutBarrier,
    SafetyFilter,
)
from safedpa.safety.barriers.base import AbstractBarrier

PERIOD = 0.05
"""s."""


@final
@dataclass(frozen=True, eq=False)
class ControlSystem:
    """x+ = f(x) + g(x) a in periods of 50 ms, and h (m,) >= 0 of states (n, states)."""

    name: str
    f: Callable[[FloatArray], FloatArray]
    """(states,) of a state (states,)."""
    g: Callable[[FloatArray], FloatArray]
    """(states, actions)."""
    h: Callable[[FloatArray], FloatArray]
    """(n, m) of states (n, states): what must not fall below 0 in truth."""
    start: Callable[[np.random.Generator], FloatArray]
    low: tuple[float, ...]
    high: tuple[float, ...]
    margin: float
    """Of h, in the half of the episodes that have one."""
    backup: Callable[[FloatArray], Any] = lambda _: 0.0
    """(actions,) what is done without a decision, at a state; nothing at all by default."""
    eta: float = 0.2
    judged: Callable[[FloatArray], FloatArray] | None = None
    """(n, m) of states (n, states): what the filter is given to keep instead of h itself."""
    barriers: Callable[[], list[AbstractBarrier]] | None = None
    """The filter's barriers, if they are not made of functions; slower to judge."""
    invariant: bool = True
    """Whether the barrier promises that h stays positive: not where an action moves h only after several periods."""
    count: int = 1
    """m."""
    swept: Callable[[FloatArray, FloatArray], float] | None = None
    """Least h in truth on the way from a state to the next one; without it the states at the ticks count."""

    def filter(self, margin: float) -> SafetyFilter:
        """The library's filter for this system."""
        settings = FilterSettings(
            action_low=self.low,
            action_high=self.high,
            backup_action=tuple(self._middle.tolist()),
            eta=self.eta,
            epsilon=margin,  # type: ignore[arg-type]
        )

        def backup(state: FloatArray | None) -> Any:
            return self._middle if state is None else np.clip(self.backup(state), self.low, self.high)

        return SafetyFilter(lambda x: (self.f(x), self.g(x)), self.given(), settings, backup=backup)

    def given(self) -> list[AbstractBarrier]:
        """The barriers that the filter is given."""
        if self.barriers is not None:
            return self.barriers()
        names, h = tuple(f"h {index}" for index in range(self.count)), self.judged or self.h
        return [FunctionBarrier(lambda x: h(x[None])[0], names=names)]

    def least_on_the_way(self, state: FloatArray, reached: FloatArray) -> float:
        """Least h in truth from one tick to the next."""
        least = float(self.h(reached[None]).min())
        return least if self.swept is None else min(least, self.swept(state, reached))

    def heights(self, states: FloatArray, since: FloatArray | None = None) -> FloatArray:
        """(n, m) what the filter is to keep, at states (n, states), which one tick leads to from ``since``."""
        if self.barriers is None:
            return (self.judged or self.h)(states)
        parts = [part if since is None else part.starting_at(since) for part in self.barriers()]
        return np.stack([np.concatenate([part.h(state) for part in parts]) for state in states])

    def after(self, state: FloatArray, actions: FloatArray) -> FloatArray:
        """x+ (n, states) under actions (n, actions)."""
        return np.asarray(self.f(state) + actions @ self.g(state).T)

    @property
    def _middle(self) -> FloatArray:
        return np.array([0.5 * (low + high) for low, high in zip(self.low, self.high, strict=True)])


_HALF_SQUARE = 0.5 * PERIOD**2
_LATE = 3
"""Periods until an action acts."""


def double_integrator() -> ControlSystem:
    """A mass before a wall at 1 m: (x [m], v [m/s]), acceleration of 1 m/s2 either way."""
    return ControlSystem(
        name="double integrator",
        f=lambda x: np.array([x[0] + PERIOD * x[1], x[1]]),
        g=lambda _: np.array([[_HALF_SQUARE], [PERIOD]]),
        h=room_before_the_wall,
        start=lambda random: np.array([random.uniform(-1.0, 0.5), random.uniform(-0.5, 0.5)]),
        low=(-1.0,),
        high=(1.0,),
        backup=lambda x: [-20.0 * x[1]],
        margin=0.002,
    )


def pendulum() -> ControlSystem:
    """An inverted pendulum of 1 m kept within 0.5 rad: (angle [rad], rate [rad/s]), torque by inertia of 12 rad/s2."""

    def f(x: FloatArray) -> FloatArray:
        pull = 9.81 * np.sin(x[0])
        return np.array([x[0] + PERIOD * x[1] + _HALF_SQUARE * pull, x[1] + PERIOD * pull])

    def h(x: FloatArray) -> FloatArray:
        sides = [_room_to_stop(0.5 - sign * x[:, 0], sign * x[:, 1], 6.0) for sign in (1.0, -1.0)]
        return np.stack(sides, axis=1)

    return ControlSystem(
        name="pendulum",
        f=f,
        g=lambda _: np.array([[_HALF_SQUARE], [PERIOD]]),
        h=h,
        start=lambda random: np.array([random.uniform(-0.2, 0.2), random.uniform(-0.3, 0.3)]),
        low=(-12.0,),
        high=(12.0,),
        backup=lambda x: [-9.81 * np.sin(x[0]) - 18.0 * x[1] - 20.0 * x[0]],
        margin=0.005,
        count=2,
    )


def adaptive_cruise() -> ControlSystem:
    """Behind a slower car: (gap [m], own speed, its speed [m/s]), acceleration of -6 to 3 m/s2."""

    def f(x: FloatArray) -> FloatArray:
        return np.array([x[0] + PERIOD * (x[2] - x[1]), x[1], x[2]])

    return ControlSystem(
        name="adaptive cruise",
        f=f,
        g=lambda _: np.array([[-_HALF_SQUARE], [PERIOD], [0.0]]),
        h=lambda x: _room_to_stop(x[:, 0] - 2.0, x[:, 1] - x[:, 2], 5.0)[:, None],
        start=lambda random: np.array(
            [random.uniform(15.0, 40.0), random.uniform(5.0, 15.0), random.uniform(3.0, 9.0)]
        ),
        low=(-6.0,),
        high=(3.0,),
        backup=lambda x: [-20.0 * (x[1] - x[2])],
        margin=0.02,
    )


def late_drive(*, looking_ahead: bool) -> ControlSystem:
    """The mass in front of a wall with three pending actions: (x, v, next action, second, third).

    ``looking_ahead``: h is judged at the state in which a new action begins to act; else here and now.
    """

    def f(x: FloatArray) -> FloatArray:
        moved = [x[0] + PERIOD * x[1] + _HALF_SQUARE * x[2], x[1] + PERIOD * x[2]]
        return np.array([*moved, *x[3 : 2 + _LATE], 0.0])

    def ahead(x: FloatArray) -> FloatArray:
        place, speed = x[:, 0], x[:, 1]
        for pending in x[:, 2:].T:
            place, speed = place + PERIOD * speed + _HALF_SQUARE * pending, speed + PERIOD * pending
        return room_before_the_wall(np.stack([place, speed], axis=1))

    return ControlSystem(
        name="delay, judged when it acts" if looking_ahead else "delay, plain barrier",
        f=f,
        g=lambda _: np.array([[0.0]] * (1 + _LATE) + [[1.0]]),
        h=room_before_the_wall,
        start=lambda random: np.array([random.uniform(-1.0, 0.0), random.uniform(-0.5, 0.3), *[0.0] * _LATE]),
        low=(-1.0,),
        high=(1.0,),
        backup=lambda x: [-5.0 * (x[1] + PERIOD * x[2:].sum())],
        margin=0.002,
        judged=ahead if looking_ahead else None,
        invariant=looking_ahead,
    )


def room_before_the_wall(x: FloatArray) -> FloatArray:
    """(n, 1) of states (n, 2 or more): position and speed come first, the wall is at 1 m."""
    return _room_to_stop(1.0 - x[:, 0], x[:, 1], 0.8)[:, None]


def _room_to_stop(room: FloatArray, speed: FloatArray, braking: float) -> FloatArray:
    """Room less the stopping distance v^2 / (2 b) and a tenth of a second of driving on."""
    fast = np.maximum(speed, 0.0)
    return np.asarray(room - fast**2 / (2.0 * braking) - 0.1 * fast)


_AHEAD = 0.1
"""m; the point of the unicycle whose distance is kept."""
_CORRIDOR = np.array([[0.6 * (index // 2), 0.55 * (-1.0) ** index] for index in range(20)])


def unicycle() -> ControlSystem:
    """(x, y [m], heading [rad]), speed of -0.5 to 1 m/s and 2 rad/s: four discs, from a point ahead of the wheels."""
    discs = np.array([[1.0, 0.0, 0.3], [0.0, 1.2, 0.4], [-1.1, -0.3, 0.3], [0.3, -1.2, 0.4]])

    def h(x: FloatArray) -> FloatArray:
        nose = x[:, :2] + _AHEAD * np.stack([np.cos(x[:, 2]), np.sin(x[:, 2])], axis=1)
        return np.asarray(_distances(nose, discs[:, :2]) - discs[:, 2])

    def g(x: FloatArray) -> FloatArray:
        return PERIOD * np.array([[np.cos(x[2]), 0.0], [np.sin(x[2]), 0.0], [0.0, 1.0]])

    return ControlSystem(
        name="unicycle",
        f=lambda x: x.copy(),
        g=g,
        h=h,
        start=lambda random: np.array([*random.uniform(-0.3, 0.3, 2), random.uniform(-np.pi, np.pi)]),
        low=(-0.5, -2.0),
        high=(1.0, 2.0),
        margin=0.002,
        count=4,
    )


def quadrotor() -> ControlSystem:
    """(x, z, tilt, vx, vz, rate), thrust of 0 to 2 g and 30 rad/s2: a floor, a ceiling, and tilt within 0.5 rad."""

    def f(x: FloatArray) -> FloatArray:
        return np.array([*(x[:3] + PERIOD * x[3:]), x[3], x[4] - PERIOD * 9.81, x[5]])

    def g(x: FloatArray) -> FloatArray:
        columns = np.zeros((6, 2))
        columns[3, 0], columns[4, 0], columns[5, 1] = -PERIOD * np.sin(x[2]), PERIOD * np.cos(x[2]), PERIOD
        columns[:3] = 0.5 * PERIOD * columns[3:]
        return columns

    def h(x: FloatArray) -> FloatArray:
        z, tilt, vz, rate = x[:, 1], x[:, 2], x[:, 4], x[:, 5]
        rows = [
            _room_to_stop(z, -vz, 5.0),
            _room_to_stop(5.0 - z, vz, 8.0),
            _room_to_stop(0.5 - tilt, rate, 20.0),
            _room_to_stop(0.5 + tilt, -rate, 20.0),
        ]
        return np.stack(rows, axis=1)

    return ControlSystem(
        name="planar quadrotor",
        f=f,
        g=g,
        h=h,
        start=lambda random: np.array([0.0, random.uniform(1.5, 3.5), *random.uniform(-0.1, 0.1, 4)]),
        low=(0.0, -30.0),
        high=(19.62, 30.0),
        backup=lambda x: [9.81 / np.cos(x[2]) - 10.0 * x[4], -20.0 * x[5] - 40.0 * x[2]],
        margin=0.005,
        count=4,
    )


def chased() -> ControlSystem:
    """(own x, y, its x, y [m]): a disc of 0.3 m follows at 0.6 m/s, one's own speed is up to 1 m/s on each axis."""

    def f(x: FloatArray) -> FloatArray:
        apart = x[:2] - x[2:]
        return np.array([*x[:2], *(x[2:] + 0.6 * PERIOD * apart / max(float(np.hypot(*apart)), 1e-9))])

    return ControlSystem(
        name="chasing obstacle",
        f=f,
        g=lambda _: PERIOD * np.vstack([np.eye(2), np.zeros((2, 2))]),
        h=lambda x: np.hypot(x[:, 0] - x[:, 2], x[:, 1] - x[:, 3])[:, None] - 0.3,
        start=lambda random: np.array([0.0, 0.0, *(_around(random) * random.uniform(0.6, 2.0))]),
        low=(-1.0, -1.0),
        high=(1.0, 1.0),
        backup=lambda x: (x[:2] - x[2:]) / max(float(np.hypot(*(x[:2] - x[2:]))), 1e-9),
        margin=0.005,
    )


def corridor() -> ControlSystem:
    """(x, y [m]) among twenty discs of 0.4 m in two rows: passages of 0.3 m, and gaps that let nothing through."""
    return ControlSystem(
        name="corridor of 20 obstacles",
        f=lambda x: x.copy(),
        g=lambda _: PERIOD * np.eye(2),
        h=lambda x: _distances(x, _CORRIDOR) - 0.4,
        start=lambda random: np.array([random.uniform(0.0, 5.0), 0.0]),
        low=(-1.0, -1.0),
        high=(1.0, 1.0),
        margin=0.002,
        count=20,
    )


def disc_of_degree_two() -> ControlSystem:
    """(x, y, vx, vy) before a disc of 0.5 m, 1 m/s2 on each axis; h is the bare distance: it is moved too late."""
    return ControlSystem(
        name="relative degree two, plain barrier",
        f=lambda x: np.array([*(x[:2] + PERIOD * x[2:]), *x[2:]]),
        g=lambda _: np.vstack([0.5 * PERIOD**2 * np.eye(2), PERIOD * np.eye(2)]),
        h=lambda x: np.hypot(x[:, 0], x[:, 1])[:, None] - 0.5,
        start=lambda random: np.array([*(_around(random) * random.uniform(1.5, 3.0)), *random.uniform(-0.3, 0.3, 2)]),
        low=(-1.0, -1.0),
        high=(1.0, 1.0),
        backup=lambda x: -20.0 * x[2:],
        margin=0.002,
        invariant=False,
    )


def _distances(points: FloatArray, centres: FloatArray) -> FloatArray:
    return np.asarray(np.hypot(points[:, :1] - centres[:, 0], points[:, 1:2] - centres[:, 1]))


def _around(random: np.random.Generator) -> FloatArray:
    bearing = random.uniform(-np.pi, np.pi)
    return np.array([np.cos(bearing), np.sin(bearing)])


_RADIUS = 0.1
"""m of the thin disc: one passes it by 0.5 m in a tick."""
_FAST = 10.0
"""m/s."""


def late_by_pending_actions() -> ControlSystem:
    """The mass in front of a wall with three pending actions: ``PendingActions`` around the model without delay."""
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
    """(x, y [m]) at up to 10 m/s on each axis, a disc of 0.1 m: h is checked at the ticks, or also between them."""

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
        margin=0.002,
        barriers=barriers if between_ticks else None,
        invariant=between_ticks,
        swept=swept,
    )


def _given(plain: ControlSystem, name: str, parts: list[AbstractBarrier]) -> ControlSystem:
    """The same system with other barriers, which promise that h stays positive."""
    return replace(plain, name=name, barriers=lambda: parts, invariant=True)
