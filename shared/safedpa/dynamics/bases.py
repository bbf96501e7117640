"""The registry of base models, by robot and kind: those that ship and those that a user's file defines."""

from __future__ import annotations

from collections.abc import Callable

from safedpa.dynamics.base import AbstractBase
from safedpa.errors import InputError
from safedpa.systems.robots import robots

__all__ = ["REGISTERED", "add_base", "bases_of", "robots_with_bases"]

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
