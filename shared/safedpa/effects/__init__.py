"""Named physical effects: one a file, with equation, parameters, units, bounds, signature and source."""

from safedpa.effects.effect import (
    AbstractEffect,
    CommandEffect,
    Context,
    RateEffect,
    SensorEffect,
    Stage,
)
from safedpa.effects.library import effect, effects_of, load_effects, robots
from safedpa.effects.parameter import Parameter

__all__ = [
    "AbstractEffect",
    "CommandEffect",
    "Context",
    "Parameter",
    "RateEffect",
    "SensorEffect",
    "Stage",
    "effect",
    "effects_of",
    "load_effects",
    "robots",
]
