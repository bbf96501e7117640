"""The base model of the pendulum: a mass at the end of a massless rod, driven by a motor."""

from __future__ import annotations

from typing import final

from safedpa.dynamics.base import AbstractBase
from safedpa.effects.effect import Named
from safedpa.effects.parameter import Parameter
from safedpa.operations import Operations
from safedpa.robots.pendulum.system import PENDULUM


@final
class RigidPendulum(AbstractBase):
    """mass length^2 d(rate)/dt = torque + mass gravity length sin(angle), with angle 0 upright.

    Source: Shi et al., Meta-Adaptive Nonlinear Control, NeurIPS 2021, appendix on the inverted pendulum.
    """

    kind = "rigid_pendulum"
    equation = "mass length^2 angle'' = torque + mass gravity length sin(angle)"
    source = "Shi et al., Meta-Adaptive Nonlinear Control, NeurIPS 2021"

    def __init__(self) -> None:
        self.system = PENDULUM
        self.parameters = (
            Parameter("length", "m", 0.01, 20.0, 0.5, neutral=None, meaning="pivot to mass"),
            Parameter("mass", "kg", 0.001, 1000.0, 1.0, neutral=None),
            Parameter("gravity", "m/s2", 0.0, 30.0, 9.81, neutral=9.81),
        )

    def rates(self, state: Named, action: Named, parameters: Named, operations: Operations) -> Named:  # noqa: D102
        mass, length = parameters["mass"], parameters["length"]
        gravity_torque = mass * parameters["gravity"] * length * operations.sin(state["angle"])
        return {"angle": state["rate"], "rate": (action["torque"] + gravity_torque) / (mass * length * length)}
