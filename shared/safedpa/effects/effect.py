"""The four kinds of physical effects, each an abstract class with one or two methods to write.

A model advances in a fixed order, whatever the order of effects in its file:

    true state  = restore(measured state)                SensorEffect
    command     = transform(action, memory)              CommandEffect   once per period, may have memory
    felt        = feel(command, true state, time)        FeltEffect      inside the integrator
    d(state)/dt = modify(rates of the base model)        RateEffect      inside the integrator
    measured    = measure(true state)                    SensorEffect

Within one kind, effects apply in the order of their ``stage``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from copy import copy
from enum import IntEnum
from functools import lru_cache
from typing import Any, ClassVar, NamedTuple, Self

from safedpa.effects.parameter import Parameter
from safedpa.operations import Operations, Scalar
from safedpa.result import one_line

Named = Mapping[str, Scalar]
"""Scalars by name: a state, an action, rates or parameters."""


class Stage(IntEnum):
    """The order in which effects apply, lower first: the physical order from command to motion.

    Effects of one stage may apply in any order: they act on different quantities, or add up.
    """

    COMMAND_SCALE = 10
    """How the receiver scales the command."""
    COMMAND_DEAD_ZONE = 12
    """Small commands that do nothing."""
    COMMAND_CURVE = 14
    """How the answer grows with the command."""
    COMMAND_DELAY = 20
    """Pure delay of the command."""
    COMMAND_LAG = 30
    """Inertia of the actuator."""
    COMMAND_SLEW = 32
    """Largest speed of the actuator."""
    COMMAND_OFFSET = 40
    """Position of the linkage at command 0: trim."""
    COMMAND_LINKAGE = 42
    """Properties of the linkage: different gains left and right, backlash."""
    COMMAND_STOPS = 44
    """Mechanical stops of the linkage."""
    SUPPLY = 46
    """Limits of the supply: battery."""
    DRIVE = 50
    """Losses of the drive itself: back-EMF."""
    RESISTANCE = 60
    """Forces that do not depend on the robot's mass: air, springs, bearings."""
    OWN_MASS = 62
    """Mass on board: drive and resistance are divided by it."""
    WEIGHT = 64
    """Decelerations that do not change with mass on board, since the force grows with weight: rolling, cornering."""
    MASS = 66
    """Inertia that all of the above has to accelerate: a towed load, a mass at the tip."""
    MOTION = 70
    """From steering to yaw rate: understeer."""
    SLIP = 72
    """Direction of travel relative to the heading."""
    DRIFT = 74
    """Motion of the medium or the ground."""
    SENSOR = 80
    """From the true state to the measured one: what is next to the reading, such as its offset."""
    SENSOR_SCALE = 82
    """Scale of a sensor."""
    SENSOR_DELAY = 84
    """Lag and delay of a sensor, which see the true rates."""


class Context(NamedTuple):
    """The inputs of a rate effect: the state and the felt action at an instant, and the base's parameters."""

    state: Named
    action: Named
    base: Named
    time: Scalar
    """Seconds since the start of the run."""
    period: float
    """s over which the action is held: friction is smoothed near rest so that no period overshoots it."""
    operations: Operations
    holds: bool = False
    """Whether dry friction keeps a stationary robot exactly at rest, for rollouts; else it is smoothed, for slopes."""


class AbstractEffect(ABC):
    """One physical effect: its equation, parameters, source, and its signature in residuals.

    Required class attributes:

    - ``name``: in model files and reports;
    - ``robot``: name of the system that it belongs to; empty for one that no file can name;
    - ``stage``: when it applies;
    - ``equation``: one readable line;
    - ``parameters``: declared with unit, bounds and neutral value;
    - ``signature``: what the residuals of a model without it look like;
    - ``source``: literature of the equation.

    At the neutral values of all parameters the model equals the model without the effect. A parameter whose neutral
    value is None only shapes the effect: it may have any value while the others are neutral.

    A search over many effects reads four more members, all of them optional: ``family``, ``partners``, ``rare`` and
    ``at_period``.
    """

    name: ClassVar[str]
    robot: ClassVar[str]
    stage: ClassVar[Stage]
    equation: ClassVar[str]
    parameters: ClassVar[tuple[Parameter, ...]]
    signature: ClassVar[str]
    source: ClassVar[str]
    timed: ClassVar[bool] = False
    """Whether it depends on the time since the start of the run."""
    needs: ClassVar[tuple[str, ...]] = ()
    """Actions that the system must have (``throttle`` for a dead zone of the throttle)."""
    mirrored: ClassVar[tuple[str, ...]] = ()
    """Parameters whose sign changes when left and right are swapped (an offset of the steering)."""
    family: ClassVar[str] = ""
    """What it is, whatever it acts on: ``friction`` for the friction of every state; empty if it is one of a kind."""
    partners: ClassVar[tuple[str, ...]] = ()
    """Names of effects of the same robot that textbooks combine with it (friction and drag, lag and gain). A search
    tries each pair jointly, also if neither effect helps alone. One side names the other; names that the robot lacks
    are ignored."""
    rare: ClassVar[bool] = False
    """Whether a search tries it only where the other effects leave something unexplained. A rare effect needs special
    hardware, or looks like a common one to first order (backlash like a delay)."""

    by_period: Callable[[float], tuple[Parameter, ...]] | None = None
    """The parameters for logs of a period [s], as a function that can be pickled; None if they do not depend on it."""

    def at_period(self, period: float) -> Self:
        """Returns the effect with bounds and typical values for logs of this period [s]; itself if they do not depend.

        A model calls it for each of its effects with its own period. A search calls it before it starts a fit.
        """
        return self if self.by_period is None else _at_period(self, period)  # type: ignore[return-value]

    def __repr__(self) -> str:
        names = ", ".join(parameter.name for parameter in self.parameters)
        return one_line(type(self).__name__, {"robot": self.robot, "name": self.name, "parameters": names})


@lru_cache(maxsize=1024)  # one object per period: recorded steps are found by their effects
def _at_period(item: AbstractEffect, period: float) -> AbstractEffect:
    assert item.by_period is not None
    parameters = item.by_period(period)
    if parameters == item.parameters:
        return item
    again = copy(item)
    again.parameters = parameters  # type: ignore[misc]
    return again


class CommandEffect(AbstractEffect):
    """An effect between the action that was sent and the action that the mechanics feel."""

    def initial_memory(self, action: Named) -> Any:
        """Returns the memory after ``action`` has been held for a long time; None for an effect without memory."""
        del action
        return None

    @abstractmethod
    def transform(
        self,
        action: Named,
        memory: Any,
        parameters: Named,
        period: float,
        operations: Operations,
    ) -> tuple[Named, Any]:
        """Returns the felt action, as its mean over the coming ``period`` [s], and the memory at its end."""


class FeltEffect(AbstractEffect):
    """An effect on the action that the mechanics feel at an instant, after delays and lags; it may see the state."""

    @abstractmethod
    def feel(self, parameters: Named, context: Context) -> Named:
        """Returns the felt action, from ``context.action``."""


class RateEffect(AbstractEffect):
    """An effect on the time derivative of the state."""

    @abstractmethod
    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:
        """Returns the rates with the effect, from the rates without it."""


class SensorEffect(AbstractEffect):
    """An effect between the true state and the measured one; an invertible map."""

    @abstractmethod
    def measure(self, state: Named, parameters: Named) -> Named:
        """Returns the measured state for a true one."""

    @abstractmethod
    def restore(self, state: Named, parameters: Named) -> Named:
        """Returns the true state for a measured one."""
