"""Base models, the physics known before any effect is added: interface, integrators, and registry by robot and kind."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import ClassVar

from safedpa.effects.effect import Named
from safedpa.effects.parameter import Parameter
from safedpa.errors import InputError
from safedpa.operations import Operations, Scalar
from safedpa.result import one_line
from safedpa.systems import System
from safedpa.systems.robots import robots


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

    def __repr__(self) -> str:
        return one_line(type(self).__name__, {"kind": self.kind, "robot": self.system.name})

    @abstractmethod
    def rates(self, state: Named, action: Named, parameters: Named, operations: Operations) -> Named:
        """Returns d(state)/dt by the name of the state's entry, in SI units per second."""

    def integrate(self, derivative: Derivative, state: Named, time: Scalar, period: float) -> Named:
        """Returns the state after ``period`` seconds of d(state)/dt = derivative(state, time)."""
        # a method, so that learned networks can override it: they predict the change over a whole period
        return runge_kutta(derivative, state, time, period)


Derivative = Callable[[Named, Scalar], Named]


def euler(derivative: Derivative, state: Named, time: Scalar, period: float) -> Named:
    """Returns state + period derivative(state, time)."""
    rates = derivative(state, time)
    return {name: value + period * rates[name] for name, value in state.items()}


def runge_kutta(derivative: Derivative, state: Named, time: Scalar, period: float) -> Named:
    """Returns the state after ``period`` [s] of d(state)/dt = derivative(state, time); local error O(period^5).

    Source: Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, section II.1.
    """
    # computed once: period may be an array over many robots, or a number that is being recorded
    half, sixth = 0.5 * period, period / 6.0
    first = derivative(state, time)
    second = derivative({name: value + half * first[name] for name, value in state.items()}, time + half)
    third = derivative({name: value + half * second[name] for name, value in state.items()}, time + half)
    fourth = derivative({name: value + period * third[name] for name, value in state.items()}, time + period)
    # the order of these operations is fixed: generated, recorded and reference steps must agree to the last bit
    return {
        name: value + sixth * (first[name] + 2.0 * (second[name] + third[name]) + fourth[name])
        for name, value in state.items()
    }


Maker = Callable[..., AbstractBase]

REGISTERED: dict[str, dict[str, Maker]] = {}
"""Constructors of the user's base models in this process, by robot and kind."""


def bases_of(robot: str) -> dict[str, Maker]:
    """Returns the constructors of one robot's base models, by kind; empty for an unknown robot."""
    known = robots()
    declared = known[robot].bases() if robot in known else {}
    # shipped kinds come last and win: a user's file must not change what the name of a shipped model means
    return {**REGISTERED.get(robot, {}), **declared}


def robots_with_bases() -> tuple[str, ...]:
    """Returns the names of the robots that have a base model."""
    return tuple(sorted({*robots(), *REGISTERED}))


def add_base(maker: Maker) -> None:
    """Registers a user's base model; registering the same kind again replaces it.

    Raises InputError if a shipped model of that robot has the same kind.
    """
    base = maker()  # the robot is an attribute of the instance: a variant may choose its system
    robot = base.system.name
    if robot in robots() and base.kind in robots()[robot].bases():
        raise InputError(f"base '{base.kind}' of robot '{robot}' ships with the project; choose another kind")
    REGISTERED.setdefault(robot, {})[base.kind] = maker
