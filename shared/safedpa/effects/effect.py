"""What a physical effect is: one of four small classes, each with one method to write.

A model advances in a fixed order, whatever the order of effects in its file:

    true state  = restore(measured state)                SensorEffect
    command     = transform(action, memory)              CommandEffect   once per period, may remember
    felt        = feel(command, true state, time)        FeltEffect      inside the integrator
    d(state)/dt = modify(rates of the base model)        RateEffect      inside the integrator
    measured    = measure(true state)                    SensorEffect

Within one kind, effects apply in the order of their ``stage``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from enum import IntEnum
from typing import Any, ClassVar, NamedTuple

from safedpa.effects.parameter import Parameter
from safedpa.operations import Operations, Scalar

__all__ = ["AbstractEffect", "CommandEffect", "Context", "FeltEffect", "RateEffect", "SensorEffect", "Stage"]

Named = Mapping[str, Scalar]
"""Scalars by name: a state, an action, rates or parameters."""


class Stage(IntEnum):
    """When an effect applies; lower first. The physical order from command to motion.

    Effects of one stage may stand in any order: they act on different quantities, or add up.
    """

    COMMAND_SCALE = 10
    """What the receiver makes of the number that was sent: gains, dead zones."""
    COMMAND_DELAY = 20
    """Pure delay of what was received."""
    COMMAND_LAG = 30
    """The actuator's inertia."""
    COMMAND_OFFSET = 40
    """Where the linkage stands when nothing is asked: trim."""
    COMMAND_LINKAGE = 42
    """What the linkage makes of it: left and right differ, play."""
    COMMAND_STOPS = 44
    """How far the linkage can go."""
    SUPPLY = 46
    """What the supply lets the drive deliver: battery."""
    DRIVE = 50
    """What the drive itself loses: back-EMF."""
    RESISTANCE = 60
    """Forces next to the drive that do not depend on the robot's mass: air, springs, bearings."""
    OWN_MASS = 62
    """Mass on board: it divides drive and resistance."""
    WEIGHT = 64
    """Decelerations that mass on board does not change, because the force grows with the weight: rolling, cornering."""
    MASS = 66
    """Inertia that all of the above has to move: a towed load, a mass at the tip."""
    MOTION = 70
    """How steering turns into a yaw rate: understeer."""
    SLIP = 72
    """Where the car travels next to where it points."""
    DRIFT = 74
    """Motion of the medium or ground that carries the robot."""
    SENSOR = 80
    """What the sensor makes of the true state."""


class Context(NamedTuple):
    """What a rate effect may look at: the state and the transformed action now, the base's parameters."""

    state: Named
    action: Named
    base: Named
    time: Scalar
    """Seconds since the start of the run."""
    period: float
    """Seconds over which the action is held: friction laws round off their sign so that no period overshoots rest."""
    operations: Operations
    holds: bool = False
    """Whether dry friction holds what stands exactly, as rollouts need it; else it is rounded off, for slopes."""


class AbstractEffect(ABC):
    """One physical effect: its equation, parameters, source, and what it looks like in residuals.

    Class attributes, all of them required:

    - ``name``: as in model files and reports;
    - ``robot``: name of the system that it belongs to; empty for one that no file can name;
    - ``stage``: when it applies;
    - ``equation``: one line a person can read;
    - ``parameters``: its numbers;
    - ``signature``: what the residuals of a model without it look like;
    - ``source``: where the equation stands.

    At the neutral values of all parameters the model is exactly the model without the effect. A parameter whose
    neutral value is None only shapes the effect: it may have any value while the others are neutral.
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
    """Names of actions without which the effect has no meaning (``throttle`` for a dead zone of the throttle)."""
    mirrored: ClassVar[tuple[str, ...]] = ()
    """Parameters whose sign flips when left and right are swapped (an offset of the steering)."""


class CommandEffect(AbstractEffect):
    """An effect between the action that was sent and the action that the mechanics feel."""

    def initial_memory(self, action: Named) -> Any:
        """What the effect remembers after ``action`` has been held for a long time; None: nothing."""
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
        """The action felt, as its mean over the coming ``period`` [s], and the memory at its end."""


class FeltEffect(AbstractEffect):
    """An effect on the action that the mechanics feel at an instant, after delays and lags; it may see the state."""

    @abstractmethod
    def feel(self, parameters: Named, context: Context) -> Named:
        """The action felt, from ``context.action``."""


class RateEffect(AbstractEffect):
    """An effect on the time derivative of the state."""

    @abstractmethod
    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:
        """The rates with the effect, from the rates without it."""


class SensorEffect(AbstractEffect):
    """An effect between the true state and the measured one; an invertible map."""

    @abstractmethod
    def measure(self, state: Named, parameters: Named) -> Named:
        """The measured state, from the true one."""

    @abstractmethod
    def restore(self, state: Named, parameters: Named) -> Named:
        """The true state, from the measured one."""
