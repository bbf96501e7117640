"""Training on a diagnosed model: what was found joins the environment e, about the value that was found."""

from __future__ import annotations

from dataclasses import replace

from safedpa.dynamics import LearnedBase, PhysicsModel
from safedpa.effects import Parameter
from safedpa.errors import InputError
from safedpa_sim.training.configuration import Configuration, Range

__all__ = ["with_diagnosed"]

_HALF = 0.5
"""Half width of a range over the distance of the value from doing nothing: as much as loads, floors and batteries
change from day to day; the configuration may name another range."""


def with_diagnosed(configuration: Configuration, model: PhysicsModel) -> Configuration:
    """The configuration with ``model`` as its simulator and each of the model's effects in the environment.

    Ranges: value +- half its distance from doing nothing, within the parameter's bounds. Ranges that the configuration
    has stay; so does its period. A parameter without a value at which it does nothing (one that only shapes its
    effect) stays as it was found. Raises InputError for a learned model, or one of another robot or other actions.
    """
    simulator, system = configuration.simulator, model.system
    if isinstance(model.base, LearnedBase):
        raise InputError("model: got a learned one, wanted physics: networks are trained on the physics that was found")
    mine, theirs = simulator.system, system
    if (mine.name, mine.state_names, mine.action_names) != (theirs.name, theirs.state_names, theirs.action_names):
        raise InputError(
            f"model: got robot '{theirs.name}' with actions {', '.join(theirs.action_names)}, "
            f"wanted '{mine.name}' with {', '.join(mine.action_names)}, as the configuration has"
        )
    environment = dict(configuration.environment)
    for item in model.effects:
        own = {f"{item.name}.{parameter.name}": parameter for parameter in item.parameters}
        if environment.keys().isdisjoint(own):
            environment |= {path: found for path, p in own.items() if (found := _range(model, path, p)) is not None}
    same_period = PhysicsModel(model.base, model.effects, model.settings, simulator.period)
    return replace(configuration, simulator=same_period, environment=environment)


def _range(model: PhysicsModel, path: str, parameter: Parameter) -> Range | None:
    value, neutral = model.settings[path].value, parameter.neutral
    if neutral is None or value == neutral:
        return None
    half = _HALF * abs(value - neutral)
    low, high = max(value - half, parameter.low), min(value + half, parameter.high)
    return (low, high) if low < high else None
