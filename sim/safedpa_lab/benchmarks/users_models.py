"""Five robots as a user writes them, over ``operations``, each behind a ``RolloutBarrier``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Final, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.dynamics import AbstractBase, PhysicsModel
from safedpa.effects import Parameter
from safedpa.operations import NUMPY
from safedpa.safety import FilterSettings, RolloutBarrier, SafetyFilter
from safedpa.systems import System, Variable

__all__ = ["ROBOTS", "UsersRobot"]

_GRAVITY: Final = 9.81


def _system(name: str, state: str, actions: Mapping[str, tuple[float, float]]) -> System:
    wide = tuple(Variable(entry, "1", -100.0, 100.0) for entry in state.split())
    return System(name, wide, tuple(Variable(entry, "1", *bounds) for entry, bounds in actions.items()))


class _Own(AbstractBase):
    equation, source = "see rates", "textbook"
    parameters: tuple[Parameter, ...] = (Parameter("scale", "1", 0.1, 10.0, 1.0, neutral=1.0),)


@final
class _DynamicBicycle(_Own):
    """A car with slipping tyres."""

    kind: ClassVar[str] = "dynamic_bicycle"
    system = _system("bicycle", "x y yaw vx vy r", {"acceleration": (-4.0, 3.0), "steering": (-0.5, 0.5)})

    def rates(self, state: Any, action: Any, parameters: Any, operations: Any) -> dict[str, Any]:
        s, o, steer = state, operations, action["steering"]
        forward = o.maximum(s["vx"], 0.5)
        front = 8.0 * o.tanh(6.0 * (steer - o.atan((s["vy"] + 1.2 * s["r"]) / forward)))
        rear = -8.0 * o.tanh(6.0 * o.atan((s["vy"] - 1.4 * s["r"]) / forward))
        return {
            "x": s["vx"] * o.cos(s["yaw"]) - s["vy"] * o.sin(s["yaw"]),
            "y": s["vx"] * o.sin(s["yaw"]) + s["vy"] * o.cos(s["yaw"]),
            "yaw": s["r"],
            "vx": action["acceleration"] + s["r"] * s["vy"],
            "vy": 0.5 * (front * o.cos(steer) + rear) - s["vx"] * s["r"],
            "r": (1.2 * front - 1.4 * rear) / 2.5,
        }


@final
class _TwoLinkArm(_Own):
    """An arm in a vertical plane."""

    kind: ClassVar[str] = "two_link_arm"
    system = _system("arm", "q1 q2 w1 w2", {"torque1": (-30.0, 30.0), "torque2": (-15.0, 15.0)})

    def rates(self, state: Any, action: Any, parameters: Any, operations: Any) -> dict[str, Any]:
        s, o = state, operations
        cos2, half = o.cos(s["q2"]), 0.5 * o.sin(s["q2"])
        m11, m12, m22 = 1.5 + cos2, 0.4 + 0.5 * cos2, 0.4
        outer = 0.4 * _GRAVITY * o.cos(s["q1"] + s["q2"])
        first = action["torque1"] + half * (2.0 * s["w1"] + s["w2"]) * s["w2"] - 0.5 * s["w1"]
        first = first - _GRAVITY * o.cos(s["q1"]) - outer
        second = action["torque2"] - half * s["w1"] * s["w1"] - 0.5 * s["w2"] - outer
        size = m11 * m22 - m12 * m12
        w1, w2 = (m22 * first - m12 * second) / size, (m11 * second - m12 * first) / size
        return {"q1": s["w1"], "q2": s["w2"], "w1": w1, "w2": w2}


@final
class _CartPole(_Own):
    """A pole that stands on a cart."""

    kind: ClassVar[str] = "cart_pole"
    system = _system("cart_pole", "x angle v w", {"force": (-20.0, 20.0)})

    def rates(self, state: Any, action: Any, parameters: Any, operations: Any) -> dict[str, Any]:
        s, sine, cosine = state, operations.sin(state["angle"]), operations.cos(state["angle"])
        push = (action["force"] + 0.05 * s["w"] * s["w"] * sine) / 1.1
        turn = (_GRAVITY * sine - cosine * push) / (0.5 * (4.0 / 3.0 - 0.1 * cosine * cosine / 1.1))
        return {"x": s["v"], "angle": s["w"], "v": push - 0.05 * turn * cosine / 1.1, "w": turn}


@final
class _Boat(_Own):
    """A boat that drifts sideways."""

    kind: ClassVar[str] = "boat"
    system = _system("boat", "x y heading u v r", {"thrust": (-40.0, 60.0), "torque": (-15.0, 15.0)})

    def rates(self, state: Any, action: Any, parameters: Any, operations: Any) -> dict[str, Any]:
        s, o = state, operations
        return {
            "x": s["u"] * o.cos(s["heading"]) - s["v"] * o.sin(s["heading"]),
            "y": s["u"] * o.sin(s["heading"]) + s["v"] * o.cos(s["heading"]),
            "heading": s["r"],
            "u": (action["thrust"] - (5.0 + 3.0 * o.absolute(s["u"])) * s["u"]) / 30.0 + s["v"] * s["r"],
            "v": -(12.0 + 8.0 * o.absolute(s["v"])) * s["v"] / 35.0 - s["u"] * s["r"],
            "r": (action["torque"] - (6.0 + 2.0 * o.absolute(s["r"])) * s["r"]) / 5.0,
        }


@final
class _PlanarQuadrotor(_Own):
    """A quadrotor in a vertical plane; its thrust and its angular acceleration are the actions."""

    kind: ClassVar[str] = "planar_quadrotor"
    system = _system("quadrotor", "x z tilt vx vz w", {"thrust": (4.0, 16.0), "turn": (-30.0, 30.0)})

    def rates(self, state: Any, action: Any, parameters: Any, operations: Any) -> dict[str, Any]:
        s, thrust = state, action["thrust"]
        vx = -thrust * operations.sin(s["tilt"]) - 0.1 * s["vx"]
        vz = thrust * operations.cos(s["tilt"]) - _GRAVITY - 0.1 * s["vz"]
        return {"x": s["vx"], "z": s["vz"], "tilt": s["w"], "vx": vx, "vz": vz, "w": action["turn"]}


def _distances(discs: tuple[tuple[float, float, float], ...]) -> Callable[[Any, Any], list[Any]]:
    def h(x: Any, operations: Any) -> list[Any]:
        return [operations.hypot(x[0] - cx, x[1] - cy) - radius for cx, cy, radius in discs]

    return h


def _brake_car(x: Any, operations: Any) -> list[Any]:
    return [operations.clip(-20.0 * x[3], -4.0, 0.0), operations.clip(-0.3 * x[5], -0.3, 0.3)]


def _hold_arm(x: Any, operations: Any) -> list[Any]:
    outer = 0.4 * _GRAVITY * operations.cos(x[0] + x[1])
    first = _GRAVITY * operations.cos(x[0]) + outer - 12.0 * x[2]
    return [operations.clip(first, -30.0, 30.0), operations.clip(outer - 4.0 * x[3], -15.0, 15.0)]


def _arm_room(x: Any, operations: Any) -> list[Any]:
    o, whole = operations, x[0] + x[1]
    along, up = o.cos(x[0]) + 0.8 * o.cos(whole), o.sin(x[0]) + 0.8 * o.sin(whole)
    discs = [o.hypot(along - cx, up - cy) - 0.2 for cx, cy in ((0.5, 1.2), (-1.0, 0.9))]
    return [1.4 - along, *discs, 2.6 - x[0], x[0] + 0.3]


def _balance(x: Any, operations: Any) -> list[Any]:
    return [operations.clip(x[0] + 45.0 * x[1] + 3.0 * x[2] + 10.0 * x[3], -20.0, 20.0)]


def _rail(x: Any, operations: Any) -> list[Any]:
    return [1.5 - x[0], 1.5 + x[0], 0.5 - x[1], 0.5 + x[1]]


def _stop_boat(x: Any, operations: Any) -> list[Any]:
    return [operations.clip(-60.0 * x[3], -40.0, 60.0), operations.clip(-20.0 * x[5], -15.0, 15.0)]


def _level(x: Any, operations: Any) -> list[Any]:
    tilt = operations.clip(0.25 * x[3], -0.5, 0.5)
    turn = operations.clip(60.0 * (tilt - x[2]) - 14.0 * x[5], -30.0, 30.0)
    return [operations.clip(_GRAVITY - 3.0 * x[4], 4.0, 16.0), turn]


@final
@dataclass(frozen=True)
class UsersRobot:
    """A base model with a backup and h, and states (start, spread) from which it is driven; ``horizon`` in ticks."""

    base: AbstractBase
    period: float
    horizon: int
    backup: Callable[[Any, Any], list[Any]]
    h: Callable[[Any, Any], list[Any]]
    start: tuple[float, ...]
    spread: tuple[float, ...]

    def made(self) -> tuple[SafetyFilter, RolloutBarrier, PhysicsModel]:
        """The filter, its barrier and the model."""
        model = PhysicsModel(self.base, period=self.period)
        rows = len(self.h(np.array(self.start), NUMPY))
        barrier = RolloutBarrier(model, self.backup, self.h, self.horizon, [f"h{row}" for row in range(rows)])
        low, high = (tuple(map(float, bound)) for bound in (model.system.action_low, model.system.action_high))
        settings = FilterSettings(
            system=model.system.name, action_low=low, action_high=high, eta=0.2, epsilon={"default": 0.001}
        )
        return SafetyFilter.for_model(model, settings, [barrier], backup=barrier.backup), barrier, model

    def requests(self, count: int, seed: int) -> list[tuple[FloatArray, FloatArray]]:
        """States and extreme nominal actions along drives of 20 ticks each."""
        random, found = np.random.default_rng(seed), list[tuple[FloatArray, FloatArray]]()
        safe, _, model = self.made()
        low, high, state = model.system.action_low, model.system.action_high, np.array(self.start)
        for index in range(count):
            if index % 20 == 0:
                state = np.array(self.start) + np.array(self.spread) * random.uniform(-1.0, 1.0, len(self.start))
            nominal = 0.5 * (high + low + random.integers(0, 2, len(low)) * (high - low))
            found.append((state, nominal))
            state = model.step(state, safe.decide(state, nominal).action)
        return found


_ROAD: Final = ((12.0, 0.5, 1.0), (20.0, -2.0, 1.5), (16.0, 3.0, 1.0), (25.0, 1.0, 1.5))
_WATER: Final = ((8.0, 0.3, 1.0), (12.0, -3.0, 1.5), (10.0, 4.0, 1.0))
_AIR: Final = ((3.0, 0.3, 0.6), (5.0, -1.0, 0.6), (3.0, 4.0, 1.0), (6.0, 2.0, 1.0))

ROBOTS: Final[Mapping[str, UsersRobot]] = {
    "dynamic bicycle": UsersRobot(
        _DynamicBicycle(), 0.05, 60, _brake_car, _distances(_ROAD), (0, 0, 0, 8, 0, 0), (2, 0.5, 0.05, 2, 0.2, 0.2)
    ),
    "2-link arm": UsersRobot(_TwoLinkArm(), 0.02, 100, _hold_arm, _arm_room, (1, 0.8, 0, 0), (0.3, 0.3, 1, 1)),
    "cart-pole": UsersRobot(_CartPole(), 0.02, 150, _balance, _rail, (0, 0, 0, 0), (0.3, 0.03, 0.3, 0.1)),
    "boat": UsersRobot(
        _Boat(), 0.1, 80, _stop_boat, _distances(_WATER), (0, 0, 0, 2, 0, 0), (2, 0.5, 0.1, 0.5, 0.2, 0.1)
    ),
    "quadrotor": UsersRobot(
        _PlanarQuadrotor(), 0.03, 80, _level, _distances(_AIR), (0, 0, 0, 1.5, 0, 0), (1, 0.5, 0.1, 0.5, 0.3, 0.3)
    ),
}
"""The kinds that an audit measured; see ``docs/explanation/kernels.md``."""
