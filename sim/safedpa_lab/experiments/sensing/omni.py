"""A robot of one's own in one file: a rectangle that drives in every direction, among boxes, with a laser.

The model knows a servo of 6 1/s for each axis. The stand-in has one of 5 1/s and at most 1.5 m/s2.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from math import atan2, cos, hypot, pi, sin
from pathlib import Path
from typing import Any, final

import numpy as np

from safedpa.dynamics import AbstractBase
from safedpa.effects import Parameter
from safedpa.policy.grid_route import GridRoute
from safedpa.robot import AbstractRobot
from safedpa.ros.face import HolonomicFace
from safedpa.safety import FilterSettings, FunctionBarrier
from safedpa.safety.barriers.planar_body import BodyPart, PlanarBody
from safedpa.stand_in import AbstractStandIn
from safedpa.systems import System, Variable
from safedpa_sim.sensing.shapes import Outline, Point, Polygon, box, clearance_at

LENGTH, WIDTH, FASTEST, TURNS = 0.6, 0.4, 0.8, 1.0
"""m, m, m/s, rad/s"""
_FIELD = (-3.5, 3.5, -3.5, 3.5)
_LIMIT, _GAIN = 1.5, 5.0
"""m/s2 and 1/s of the stand-in."""
_BOXES, _TRIES = 4, 4000
_ROOM = 0.45
"""m that goals keep to everything."""

SYSTEM = System(
    name="omni",
    state=(
        Variable("x", "m", -1e3, 1e3),
        Variable("y", "m", -1e3, 1e3),
        Variable("yaw", "rad", -np.inf, np.inf, angle=True),
        Variable("forward", "m/s", -5.0, 5.0),
        Variable("left", "m/s", -5.0, 5.0),
        Variable("turn_rate", "rad/s", -10.0, 10.0),
    ),
    action=(
        Variable("target_forward", "m/s", -2.0, 2.0),
        Variable("target_left", "m/s", -2.0, 2.0),
        Variable("target_turn_rate", "rad/s", -3.0, 3.0),
    ),
)


@final
class OmniServo(AbstractBase):
    """v' = gain (target - v) for each entry of the velocity in the robot's own frame."""

    kind = "omni_servo"
    equation = "forward' = gain (target_forward - forward), and so on"
    source = "first-order servo"
    system = SYSTEM
    parameters = (Parameter("gain", "1/s", 0.5, 30.0, 6.0, neutral=None),)

    def rates(self, state: Any, action: Any, parameters: Any, operations: Any) -> Any:  # noqa: D102
        cosine, sine, gain = operations.cos(state["yaw"]), operations.sin(state["yaw"]), parameters["gain"]
        return {
            "x": state["forward"] * cosine - state["left"] * sine,
            "y": state["forward"] * sine + state["left"] * cosine,
            "yaw": state["turn_rate"],
            "forward": gain * (action["target_forward"] - state["forward"]),
            "left": gain * (action["target_left"] - state["left"]),
            "turn_rate": gain * (action["target_turn_rate"] - state["turn_rate"]),
        }


@final
class Omni(AbstractRobot):
    """An omnidirectional robot with a rectangular body."""

    system = SYSTEM
    rate = 20.0
    model = Path(__file__).with_name("omni.toml")
    kinds = ("speed", "obstacle", "mover")
    measurement_deviation = (0.003, 0.003, 0.005, 0.01, 0.01, 0.02)

    def bases(self) -> Mapping[str, Callable[..., AbstractBase]]:  # noqa: D102
        return {OmniServo.kind: OmniServo}

    def settings(self) -> FilterSettings:  # noqa: D102
        high = (FASTEST, FASTEST, TURNS)
        low = tuple(-entry for entry in high)
        margins = {"speed": 0.02, "obstacle": 0.02, "mover": 0.05}
        return FilterSettings(system="omni", action_low=low, action_high=high, eta=0.3, epsilon=margins)

    def barriers(self, state: Any, model: Any, latent: Any, settings: Any) -> Sequence[FunctionBarrier]:  # noqa: D102
        names = SYSTEM.state_names
        return (FunctionBarrier(lambda x: 1.3 - hypot(x[3], x[4]), names=("haste",), kind="speed", reads=names),)

    def planar_body(self, model: Any, settings: Any) -> PlanarBody:  # noqa: D102
        half, side = LENGTH / 2, WIDTH / 2
        rectangle = BodyPart(((-half, -side), (half, -side), (half, side), (-half, side)))
        return PlanarBody(
            1.2, 4.0, 1.3, ("x", "y", "yaw"), ("forward", "left"), turn_rate="turn_rate", turning=0.25,
            parts=(rectangle,), creeping=3.0,
        )  # fmt: skip

    def ros_face(self, model: Any = None) -> HolonomicFace:  # noqa: D102
        del model
        return HolonomicFace()

    def controllers(self, model: Any) -> Mapping[str, Callable[[], Any]]:  # noqa: D102
        return {"goal_seeker": Seeker}

    def effects(self) -> Iterable[Any]:  # noqa: D102
        return ()

    def stand_in(self, seed: int, given: Mapping[str, float]) -> AbstractStandIn:  # noqa: D102
        return Boxes(seed, **given)


@final
class Seeker:
    """Follows the route at up to 0.7 m/s, and turns its long axis into the direction of motion."""

    def __init__(self) -> None:
        self._route = GridRoute(WIDTH / 2 + 0.15)

    def look(self, seen: Any) -> None:
        """Sets the surroundings for the next state."""
        self._route.look(seen)

    def nominal_action(self, state: Any, latent: Any) -> tuple[tuple[float, ...], str]:
        """Returns the action (3,) and the controller's name."""
        del latent
        x, y, yaw = state.values[:3]
        to_x, to_y = self._route.aim((x, y), state.goal, state.robot_time)
        way = atan2(to_y - y, to_x - x) - yaw
        speed = min(0.7, 1.5 * hypot(to_x - x, to_y - y) + 0.1)
        turn = (way + pi / 2) % pi - pi / 2
        return (speed * cos(way), speed * sin(way), min(max(1.5 * turn, -TURNS), TURNS)), "goal_seeker"


@final
class Boxes(AbstractStandIn):
    """The robot among boxes in a square field; it passes through them, which the experiment counts."""

    field = _FIELD

    def __init__(self, seed: int) -> None:
        self._draw = np.random.default_rng([seed, 41])
        self.polygons: tuple[Polygon, ...] = ()
        self._state = np.zeros(6)
        while len(self.polygons) < _BOXES:
            x, y = self._draw.uniform(-2.4, 2.4, 2).tolist()
            outline = Outline(((0.0, 0.0, 0.35),), self.polygons)
            if clearance_at(outline, x, y) > 1.1:
                length, width, yaw = self._draw.uniform((0.4, 0.3, 0.0), (0.9, 0.6, pi)).tolist()
                self.polygons = (*self.polygons, box(x, y, length, width, yaw))
        self._goal = self._next_goal()

    @property
    def values(self) -> tuple[float, ...]:
        """x, y, yaw, forward, left, turn rate."""
        return tuple(self._state.tolist())

    @property
    def goal(self) -> tuple[float, ...]:
        """(2,) m."""
        return self._goal

    def advance(self, action: tuple[float, ...], seconds: float) -> None:
        """Small steps of the servo with limited acceleration."""
        steps = max(1, round(seconds / 0.005))
        pace = seconds / steps
        for _ in range(steps):
            pull = _GAIN * (np.array(action) - self._state[3:])
            size = float(np.hypot(pull[0], pull[1]))
            pull[:2] *= min(1.0, _LIMIT / max(size, 1e-9))
            x, y, yaw, forward, left, turn = self._state
            self._state[:2] = (
                x + pace * (forward * cos(yaw) - left * sin(yaw)),
                y + pace * (forward * sin(yaw) + left * cos(yaw)),
            )
            self._state[2] = yaw + pace * turn
            self._state[3:] += pace * pull
        if hypot(self._state[0] - self._goal[0], self._state[1] - self._goal[1]) < 0.3:
            self.goals_reached += 1
            self._goal = self._next_goal()

    def contact(self) -> str:
        """Always empty: the experiment counts contacts of the polygon."""
        return ""

    def watchdog_action(self) -> tuple[float, ...]:
        """Stops."""
        return (0.0, 0.0, 0.0)

    def _next_goal(self) -> Point:
        outline = Outline((), self.polygons, (_FIELD,))
        for _ in range(_TRIES):
            x, y = self._draw.uniform(-3.0, 3.0, 2).tolist()
            away = hypot(x - self._state[0], y - self._state[1])
            inside = any(_within(polygon, x, y) for polygon in self.polygons)
            if away > 1.5 and not inside and clearance_at(outline, x, y) > _ROOM:
                return x, y
        return 0.0, 0.0


def _within(corners: Polygon, x: float, y: float) -> bool:
    pairs = zip(corners, corners[1:] + corners[:1], strict=True)
    return all((bx - ax) * (y - ay) - (by - ay) * (x - ax) > 0.0 for (ax, ay), (bx, by) in pairs)
