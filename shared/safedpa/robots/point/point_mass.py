"""The base model of the point robot: a point mass on frictionless slides with thrust along its heading."""

from __future__ import annotations

from typing import final

from safedpa.dynamics.base import AbstractBase
from safedpa.effects.effect import Named
from safedpa.effects.parameter import Parameter
from safedpa.operations import Operations
from safedpa.robots.point.system import POINT


@final
class PointMass(AbstractBase):
    """mass d(vx, vy)/dt = thrust (cos(yaw), sin(yaw)), d(x, y)/dt = (vx, vy), d(yaw)/dt = turn.

    Source: Newton's second law. Valid while the turn servo is fast compared to the motion and thrust does not saturate.
    """

    kind = "point_mass"
    equation = "mass v' = thrust (cos yaw, sin yaw), yaw' = turn"
    source = "Newton's second law"

    def __init__(self) -> None:
        self.system = POINT
        self.parameters = (Parameter("mass", "kg", 1e-6, 1000.0, 1.0, neutral=None),)

    def rates(self, state: Named, action: Named, parameters: Named, operations: Operations) -> Named:  # noqa: D102
        push = action["thrust"] / parameters["mass"]
        return {
            "x": state["vx"],
            "y": state["vy"],
            "yaw": action["turn"],
            "vx": push * operations.cos(state["yaw"]),
            "vy": push * operations.sin(state["yaw"]),
        }
