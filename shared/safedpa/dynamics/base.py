"""A base model: the physics that is known before any effect is added."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import ClassVar

from safedpa.dynamics.runge_kutta import Derivative, runge_kutta
from safedpa.effects.effect import Named
from safedpa.effects.parameter import Parameter
from safedpa.operations import Operations, Scalar
from safedpa.systems import System

__all__ = ["AbstractBase"]


class AbstractBase(ABC):
    """Known physics of one kind of robot: the time derivative of the state, with named parameters."""

    kind: ClassVar[str]
    equation: ClassVar[str]
    source: ClassVar[str]
    system: System
    parameters: tuple[Parameter, ...]
    choices: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    """Keys of a model file's base table that choose among variants, each with what it may be; arguments by these names
    of whatever makes the base."""
    straight: ClassVar[bool] = True
    """Whether the equations are the same arithmetic on named scalars whatever their values."""

    @abstractmethod
    def rates(self, state: Named, action: Named, parameters: Named, operations: Operations) -> Named:
        """d(state)/dt by name of the state's entry, in SI units per second."""

    def integrate(self, derivative: Derivative, state: Named, time: Scalar, period: float) -> Named:
        """The state after ``period`` seconds from d(state)/dt = derivative(state, time)."""
        return runge_kutta(derivative, state, time, period)
