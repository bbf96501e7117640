"""A simulated differential drive with motor lag, slipping tyres and mass, among obstacles and walls, with goals.

Per step of 2.5 ms, with wheel radius factors k_left, k_right and the true track b:

    motor:   d(wheel)/dt = clip((target - wheel) / lag, +-limit / (1 + payload)),  target = k (speed -+ turn b_nom / 2)
    tyre:    forward force = clip(stiffness (wheel - ground), +-grip weight / 2), sideways = clip(-stiffness slide, ...)
    castor:  force = -carpet mass sign(speed)
    body:    Newton and Euler, semi-implicit

b_nom is the track that the driver assumes. None of the equations is in the model library. A robot that touches an
object stays there until it is driven away.
"""

from __future__ import annotations

from math import atan2, copysign, cos, hypot, inf, isfinite, sin, tanh

import numpy as np

from safedpa.errors import InputError
from safedpa.robots.differential_drive.system import TRACK
from safedpa.stand_in import AbstractStandIn, Numbers

RADIUS = 0.17
"""m"""
WORLDS: dict[str, dict[str, float]] = {
    "plain": {},
    "loaded": {"payload": 0.4, "carpet": 0.15},
    "worn": {"radius": 0.94, "difference": 0.03, "track": 1.05},
    "slippery": {"grip": 0.25, "lag": 0.14},
}
"""Named sets of world parameters."""
_SUBSTEP = 0.0025
_LIMIT = 1.2
"""m/s2 of a wheel without load."""
_MASS, _INERTIA, _GRAVITY = 4.0, 0.06, 9.81
_STIFFNESS = 120.0
"""N s/m"""
_FIELD = 3.0
_OBSTACLES, _TRIES = 7, 400
_GOAL_RADIUS = 0.25
_LIMITS = {
    "payload": (0.0, 1.0), "radius": (0.7, 1.3), "difference": (-0.2, 0.2), "track": (0.7, 1.3), "grip": (0.05, 1.5),
    "lag": (0.02, 0.5), "carpet": (0.0, 1.0),
}  # fmt: skip


class WheeledStandIn(AbstractStandIn):
    """The simulated robot.

    World parameters: ``payload`` (mass over own mass), ``radius`` and ``track`` (true over assumed value),
    ``difference`` (of the wheel radii over their mean), ``grip`` of the tyres, ``lag`` [s] of the motors, and
    ``carpet`` [m/s2]. Raises InputError for an unknown parameter or a value out of range.
    """

    field = (-_FIELD, _FIELD, -_FIELD, _FIELD)

    def __init__(
        self,
        seed: int,
        payload: float = 0.0,
        radius: float = 1.0,
        difference: float = 0.0,
        track: float = 1.0,
        grip: float = 0.8,
        lag: float = 0.1,
        carpet: float = 0.0,
    ) -> None:
        asked = {
            "payload": payload, "radius": radius, "difference": difference, "track": track, "grip": grip, "lag": lag,
            "carpet": carpet,
        }  # fmt: skip
        for name, value in asked.items():
            low, high = _LIMITS[name]
            if not (isfinite(value) and low <= value <= high):
                raise InputError(f"--world {name}={value:g}: wanted {low:g} to {high:g}")
        self._world = asked
        self._random = np.random.default_rng([seed, 5])
        self._obstacles = self._placed()
        self._x, self._y, self._yaw = 0.0, 0.0, float(self._random.uniform(-3.0, 3.0))
        self._forward = self._sideways = self._turn = 0.0
        self._wheels = [0.0, 0.0]
        self._touched = ""
        self._goal = self._next_goal()

    @property
    def values(self) -> Numbers:
        """x, y, yaw, speed, turn rate."""
        return (self._x, self._y, self._yaw, self._forward, self._turn)

    @property
    def goal(self) -> Numbers:
        """(2,) m."""
        return self._goal

    @property
    def obstacles(self) -> tuple[Numbers, ...]:
        """x, y, radius of each."""
        return self._obstacles

    @property
    def footprint(self) -> Numbers:
        """A disc around the centre of the axle."""
        return (0.0, 0.0, RADIUS)

    def advance(self, action: Numbers, seconds: float) -> None:
        """Simulates ``seconds`` in equal steps of about 2.5 ms."""
        count = max(1, round(seconds / _SUBSTEP))
        for _ in range(count):
            self._substep(action, seconds / count)
        if hypot(self._x - self._goal[0], self._y - self._goal[1]) < _GOAL_RADIUS:
            self.goals_reached += 1
            self._goal = self._next_goal()

    def _substep(self, action: Numbers, pace: float) -> None:
        world = self._world
        mass, half = _MASS * (1.0 + world["payload"]), 0.5 * TRACK * world["track"]
        inertia, hold = _INERTIA * (1.0 + world["payload"]), 0.5 * world["grip"] * mass * _GRAVITY
        limit = _LIMIT / (1.0 + world["payload"])
        push = torque = 0.0
        for side, sign in enumerate((-1.0, 1.0)):
            scale = world["radius"] * (1.0 + 0.5 * sign * world["difference"])
            target = scale * (action[0] + sign * 0.5 * TRACK * action[1])
            self._wheels[side] += pace * _clip((target - self._wheels[side]) / world["lag"], limit)
            ground = self._forward + sign * half * self._turn
            force = _clip(_STIFFNESS * (self._wheels[side] - ground), hold)
            push += force
            torque += sign * half * force
        push -= world["carpet"] * mass * tanh(self._forward / 0.01)
        aside = _clip(-2.0 * _STIFFNESS * self._sideways, 2.0 * hold)
        forward, sideways = self._forward, self._sideways
        self._forward += pace * (push / mass + self._turn * sideways)
        self._sideways += pace * (aside / mass - self._turn * forward)
        self._turn += pace * torque / inertia
        self._yaw += pace * self._turn
        self._move(pace)

    def _move(self, pace: float) -> None:
        cosine, sine = cos(self._yaw), sin(self._yaw)
        x = self._x + pace * (self._forward * cosine - self._sideways * sine)
        y = self._y + pace * (self._forward * sine + self._sideways * cosine)
        now, then = self._room(self._x, self._y), self._room(x, y)
        if then[0] < 0.0 and then[0] < now[0]:
            self._touched = then[1]
            self._forward = self._sideways = 0.0
            return
        self._touched = ""
        self._x, self._y = x, y

    def _room(self, x: float, y: float) -> tuple[float, str]:
        """Returns the distance [m] to the nearest object and its name."""
        near = [
            (hypot(x - ox, y - oy) - size - RADIUS, f"obstacle {k}") for k, (ox, oy, size) in enumerate(self._obstacles)
        ]
        walls = [(_FIELD - RADIUS - abs(x), "wall"), (_FIELD - RADIUS - abs(y), "wall")]
        return min([*near, *walls])

    def contact(self) -> str:
        """Returns the obstacle or wall that the robot touches; empty if none."""
        return self._touched

    def watchdog_action(self) -> Numbers:
        """Returns the action to stop."""
        return (0.0, 0.0)

    def _placed(self) -> tuple[tuple[float, float, float], ...]:
        found: list[tuple[float, float, float]] = []
        for _ in range(_TRIES):
            x, y = self._random.uniform(-_FIELD + 0.9, _FIELD - 0.9, 2).tolist()
            size = float(self._random.uniform(0.15, 0.3))
            apart = min((hypot(x - ox, y - oy) - size - other for ox, oy, other in found), default=inf)
            if apart > 2.0 * RADIUS + 0.3 and hypot(x, y) > size + RADIUS + 0.3:
                found.append((x, y, size))
            if len(found) == _OBSTACLES:
                break
        return tuple(found)

    def _next_goal(self) -> tuple[float, float]:
        """Draws a free goal at least 1.5 m away, behind an obstacle if possible."""
        free: list[tuple[float, float]] = []
        while len(free) < 12:
            x, y = self._random.uniform(-_FIELD + 0.6, _FIELD - 0.6, 2).tolist()
            if hypot(x - self._x, y - self._y) < 1.5:
                continue
            if all(hypot(x - ox, y - oy) > size + RADIUS + 0.2 for ox, oy, size in self._obstacles):
                free.append((x, y))
                if self._hides(x, y):
                    return (x, y)
        return free[0]

    def _hides(self, x: float, y: float) -> bool:
        way, far = atan2(y - self._y, x - self._x), hypot(x - self._x, y - self._y)
        for ox, oy, size in self._obstacles:
            along = (ox - self._x) * cos(way) + (oy - self._y) * sin(way)
            across = (oy - self._y) * cos(way) - (ox - self._x) * sin(way)
            if 0.0 < along < far and abs(across) < size:
                return True
        return False


def _clip(value: float, most: float) -> float:
    return value if abs(value) <= most else copysign(most, value)
