"""Base models by robot and kind: those that ship, and a user's own."""

from __future__ import annotations

from collections.abc import Callable

from safedpa.dynamics.base import AbstractBase
from safedpa.errors import InputError
from safedpa.robot import robots

__all__ = ["REGISTERED", "add_base", "bases_of", "robots_with_bases"]

Maker = Callable[..., AbstractBase]

REGISTERED: dict[str, dict[str, Maker]] = {}
"""Base models that this process registered, by robot and kind."""


def bases_of(robot: str) -> dict[str, Maker]:
    """What makes the base models of one robot, by kind; empty for an unknown robot."""
    known = robots()
    declared = known[robot].bases() if robot in known else {}
    return {**REGISTERED.get(robot, {}), **declared}


def robots_with_bases() -> tuple[str, ...]:
    """Names of the robots that have a base model."""
    return tuple(sorted({*robots(), *REGISTERED}))


def add_base(maker: Maker) -> None:
    """Makes a user's own base model known; the same kind again replaces it.

    Raises InputError when it bears the kind of one that ships, or its rates are not those of its system's state.
    """
    base = maker()
    robot = base.system.name
    if robot in robots() and base.kind in robots()[robot].bases():
        raise InputError(f"base '{base.kind}' of robot '{robot}' ships with the project; choose another kind")
    REGISTERED.setdefault(robot, {})[base.kind] = maker
