"""The interface of a base model: the physics that is known before any effect is added."""

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
    """Known physics of one kind of robot: d(state)/dt with named parameters.

    ``kind`` names it in model files, ``equation`` and ``source`` in reports.
    """

    kind: ClassVar[str]
    equation: ClassVar[str]
    source: ClassVar[str]
    system: System
    parameters: tuple[Parameter, ...]
    choices: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    """Keys in a model file's base table that select a variant, each with its allowed values. They are passed to the
    constructor by name."""
    recordable: ClassVar[bool] = True
    """Whether the equations do the same arithmetic for all values, without a branch, so that they can be recorded."""

    @abstractmethod
    def rates(self, state: Named, action: Named, parameters: Named, operations: Operations) -> Named:
        """Returns d(state)/dt by the name of the state's entry, in SI units per second."""

    def integrate(self, derivative: Derivative, state: Named, time: Scalar, period: float) -> Named:
        """Returns the state after ``period`` seconds of d(state)/dt = derivative(state, time)."""
        # a method, so that learned networks can override it: they predict the change over a whole period
        return runge_kutta(derivative, state, time, period)
