"""The library for a system of one's own: every general effect on its actions and on the rates of its states."""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite

from safedpa.effects.effect import AbstractEffect
from safedpa.effects.general_commands import (
    ChannelDeadZone,
    ChannelDelay,
    ChannelGain,
    ChannelLag,
    ChannelLimit,
    ChannelOffset,
)
from safedpa.effects.general_rates import StateDrag, StateFriction, StatePush, StateQuadraticDrag
from safedpa.errors import InputError, did_you_mean
from safedpa.systems import System, Variable

__all__ = ["general_effects"]


def general_effects(system: System, moving: Mapping[str, float] | None = None) -> tuple[AbstractEffect, ...]:
    """Gain, offset, dead zone, limit, lag and delay of every action; drag, quadratic drag, friction and push of states.

    ``moving``: the states that forces change (speeds, rates), each with what is usual of it in its unit. Actions
    without finite bounds count as up to 1 of their unit. Raises InputError for a state that the system lacks.
    """
    found: list[AbstractEffect] = []
    for action in system.action:
        found += _of_action(system.name, action)
    for name, size in (moving or {}).items():
        if name not in system.state_names:
            raise InputError(f"moving: got '{name}'; {did_you_mean(name, system.state_names)}")
        if not (isfinite(size) and size > 0.0):
            raise InputError(f"moving: {name}: got {size!r}, wanted what is usual of it, above 0")
        unit = system.state[system.state_names.index(name)].unit
        found += [
            StateDrag(system.name, name, size),
            StateQuadraticDrag(system.name, name, unit, size),
            StateFriction(system.name, name, unit, size),
            StatePush(system.name, name, unit, size),
        ]
    return tuple(found)


def _of_action(robot: str, action: Variable) -> list[AbstractEffect]:
    size = max(abs(action.low), abs(action.high))
    size = size if isfinite(size) else 1.0
    found: list[AbstractEffect] = [
        ChannelGain(robot, action.name),
        ChannelOffset(robot, action.name, action.unit, size),
        ChannelLag(robot, action.name),
        ChannelDelay(robot, action.name),
        ChannelLimit(robot, action.name, action.unit, size),
    ]
    return [*found, ChannelDeadZone(robot, action.name, action.unit, size)] if action.low < 0.0 else found
