"""Named physical effects, each with equation, parameters, units, bounds, signature and source.

Read ``effect`` first (the four kinds of effects and their order), then ``channel_effects`` (gain, lag, delay, ... of
any command), ``library`` (all known effects) and ``law`` (effects that depend on where and when). The effects of a
robot are in its own package; ``general`` makes them for a user's own system.
"""

from safedpa.effects.effect import (
    AbstractEffect,
    CommandEffect,
    Context,
    FeltEffect,
    RateEffect,
    SensorEffect,
    Stage,
)
from safedpa.effects.general import general_effects
from safedpa.effects.law import Conditioned, Varies, Where, conditioned
from safedpa.effects.library import effect, effects_of, load_effects, robots
from safedpa.effects.parameter import Parameter

__all__ = [
    "AbstractEffect",
    "CommandEffect",
    "Conditioned",
    "Context",
    "FeltEffect",
    "Parameter",
    "RateEffect",
    "SensorEffect",
    "Stage",
    "Varies",
    "Where",
    "conditioned",
    "effect",
    "effects_of",
    "general_effects",
    "load_effects",
    "robots",
]
