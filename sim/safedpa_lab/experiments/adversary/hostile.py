"""A policy that wants to hit something: in the policy's place on the bus, for the car and the point robot."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Final, final

import numpy as np

from safedpa.bus import NOMINAL, AbstractNode, Inputs, NominalMessage, Outputs, StateMessage

NominalPolicy = Callable[[StateMessage, np.random.Generator], tuple[float, ...]]

_SPEED: Final = (-0.6, 2.0)
_STEER: Final = 0.34
_THRUST: Final = 0.05
_TURN: Final = 4.0
_TORQUE: Final = 10.0
_LEG: Final = 1.0
"""s between two changes of mind."""


@final
@dataclass
class HostileNode(AbstractNode):
    """Publishes ``nominal_policy(state, random)`` in every tick."""

    nominal_policy: NominalPolicy
    seed: int
    name: ClassVar[str] = "policy"
    inputs: ClassVar[tuple[Any, ...]] = ()
    outputs: ClassVar[tuple[Any, ...]] = (NOMINAL,)
    share: ClassVar[float] = 0.2
    defers_afterwards: ClassVar[bool] = False

    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:  # noqa: D102
        del robot, inputs
        random = np.random.default_rng([self.seed, 5, int(state.robot_time / _LEG)])
        message = NominalMessage(
            epoch=state.epoch,
            tick=state.tick,
            robot_time=state.robot_time,
            publish_time=time.time(),
            values=self.nominal_policy(state, random),
            controller="adversary",
        )
        return {NOMINAL: message}


def at_nearest(state: StateMessage, random: np.random.Generator) -> tuple[float, ...]:
    """A car at full speed at the nearest thing that is not behind it, or at the nearest of all."""
    x, y, yaw, _ = state.values
    ahead = [place for place in _places(state) if _along(place, x, y, yaw) > 0.0]
    near = _nearest(ahead if ahead and random.uniform() < 0.7 else _places(state), x, y)
    bearing = math.atan2(near[1] - y, near[0] - x) - yaw
    return _SPEED[1], math.copysign(_STEER, math.sin(bearing))


def rocking(state: StateMessage, random: np.random.Generator) -> tuple[float, ...]:
    """A car from one end of its actuators to the other, now forwards, now backwards, as chance has it."""
    del state
    return float(random.choice(_SPEED)), float(random.choice((-_STEER, _STEER)))


def thrusting(state: StateMessage, random: np.random.Generator) -> tuple[float, ...]:
    """A point robot with full thrust at the nearest hazard, nose or tail first."""
    x, y, yaw = state.values[:3]
    near = _nearest(list(state.obstacles), x, y)
    bearing = math.atan2(near[1] - y, near[0] - x) - yaw
    ahead = math.cos(bearing) >= 0.0
    turn = math.sin(bearing) if ahead else -math.sin(bearing)
    return (_THRUST if ahead else -_THRUST), float(np.clip(_TURN * turn, -_TURN, _TURN)) * random.choice((1.0, 0.2))


def falling(state: StateMessage, random: np.random.Generator) -> tuple[float, ...]:
    """A pendulum with full torque out of its corridor, or now and then the other way with all of its swing."""
    low, high = state.corridor[:2]
    outwards = 1.0 if state.values[0] > 0.5 * (low + high) else -1.0
    return (_TORQUE * outwards * float(random.choice((1.0, 1.0, -1.0))),)


def _places(state: StateMessage) -> list[tuple[float, ...]]:
    x, y = state.values[:2]
    west, east, south, north = state.field
    walls = [(west, y, 0.0), (east, y, 0.0), (x, south, 0.0), (x, north, 0.0)]
    return [*state.obstacles, *walls]


def _nearest(places: Sequence[tuple[float, ...]], x: float, y: float) -> tuple[float, ...]:
    return min(places, key=lambda place: math.hypot(place[0] - x, place[1] - y) - place[2])


def _along(place: tuple[float, ...], x: float, y: float, yaw: float) -> float:
    return math.cos(yaw) * (place[0] - x) + math.sin(yaw) * (place[1] - y)
