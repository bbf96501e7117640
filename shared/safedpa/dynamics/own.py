"""A user's own robots, systems, base models and effects, from one Python file outside the project.

Files are named by an option, by the environment variable SAFEDPA_EFFECTS (several with the path separator between
them, so that every process of a loop knows them), or by an entry point ``safedpa.effects`` that names a module.
"""

from __future__ import annotations

import inspect
import os
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

from safedpa.barrier_setting import BarrierSetting
from safedpa.dynamics.base import AbstractBase
from safedpa.dynamics.bases import add_base
from safedpa.effects.library import add_effects, module_from
from safedpa.errors import InputError
from safedpa.installed import entry_points_of_group
from safedpa.limits import finite_number
from safedpa.operations import FLOATS
from safedpa.robot import AbstractRobot, add_robot
from safedpa.systems import System, add_system, systems

__all__ = ["EFFECTS_VARIABLE", "load_own", "load_own_everywhere", "load_own_of_environment"]

_DECLARED = ("system", "rate", "measurement_deviation")
"""Attributes without which nothing of a robot works."""

EFFECTS_VARIABLE = "SAFEDPA_EFFECTS"
"""Name of the environment variable."""


def load_own(path: Path) -> list[str]:
    """Loads a file; returns the names of what it added, systems first.

    Raises InputError when it cannot be run as Python, defines nothing, or what it defines is incomplete.
    """
    found = _added(module_from(path), path)
    if not found:
        raise InputError(
            f"{path}: got no effect, wanted a class derived from RateEffect, CommandEffect or SensorEffect, a System, "
            "a base model, or a robot"
        )
    return found


def load_own_everywhere(path: Path) -> list[str]:
    """The same, and every process that this one starts knows it too."""
    found = load_own(path)
    known = [item for item in os.environ.get(EFFECTS_VARIABLE, "").split(os.pathsep) if item]
    os.environ[EFFECTS_VARIABLE] = os.pathsep.join(dict.fromkeys([*known, str(path.resolve())]))
    return found


def load_own_of_environment() -> None:
    """Loads what the environment variable and the entry points name, each once in this process."""
    for name in os.environ.get(EFFECTS_VARIABLE, "").split(os.pathsep):
        if name:
            _loaded_once(name)
    _entry_points_once()


@cache
def _loaded_once(name: str) -> tuple[str, ...]:
    return tuple(load_own(Path(name)))


@cache
def _entry_points_once() -> None:
    """Systems and bases of installed modules; their effects are in the library already."""
    for entry in entry_points_of_group("safedpa.effects"):
        module = entry.load()
        for item in _systems_in(module):
            add_system(item)
        for base in _bases_in(module):
            add_base(base)


def _added(module: ModuleType, path: Path) -> list[str]:
    robots_found = _robots_in(module, path)
    for robot in robots_found:
        try:
            add_robot(robot)
        except InputError as error:
            raise InputError(f"{path}: {error}") from error
    own = _systems_in(module)
    for system in own:
        try:
            add_system(system)
        except InputError as error:
            raise InputError(f"{path}: {error}") from error
    bases = _bases_in(module)
    for base in bases:
        _check_base(base, path)
        if base not in [made for robot in robots_found for made in robot.bases().values()]:
            add_base(base)
    names = [*(item.name for item in robots_found), *(item.name for item in own), *(item.kind for item in bases)]
    return [*names, *(item.name for item in add_effects(module, path))]


def _robots_in(module: ModuleType, path: Path) -> list[AbstractRobot]:
    """One of each class of robot that a module defines. Raises InputError for one that does not declare everything."""
    found = []
    for name, item in inspect.getmembers(module, inspect.isclass):
        if item.__module__ != module.__name__ or not issubclass(item, AbstractRobot):
            continue
        lacking = sorted({*item.__abstractmethods__, *(part for part in _DECLARED if not hasattr(item, part))})
        if lacking:
            raise InputError(f"{path}: class {name}: '{lacking[0]}' is missing; declare it as AbstractRobot says")
        label = f"{path}: class {name}"
        try:
            robot = item()
            bases = robot.bases()
        except Exception as error:  # a user's class may fail in any way
            raise InputError(f"{label}: failed with {type(error).__name__}: {error}") from error
        _check_declared(robot, bases, label)
        found.append(robot)
    return found


def _check_declared(robot: AbstractRobot, bases: Any, label: str) -> None:
    """Raises InputError for what would else fail far from where it was written."""
    if not isinstance(robot.system, System):
        raise InputError(f"{label}: system: got {type(robot.system).__name__}, wanted a System")
    kinds: Any = robot.kinds
    if finite_number(f"{label}: rate", robot.rate) <= 0.0:
        raise InputError(f"{label}: rate: got {robot.rate}, wanted ticks a second, more than 0")
    if isinstance(kinds, str):
        raise InputError(f"{label}: kinds: got '{kinds}', wanted a tuple of names, such as ('{kinds}',)")
    if not isinstance(robot.barrier_settings, (tuple, list)) or not all(
        isinstance(item, BarrierSetting) for item in robot.barrier_settings
    ):
        raise InputError(f"{label}: barrier_settings: got {robot.barrier_settings!r}, wanted a tuple of BarrierSetting")
    if not isinstance(bases, Mapping) or not all(map(callable, bases.values())):
        raise InputError(f"{label}: bases: got {bases!r}, wanted a table of base models by kind: {{'kind': Class}}")


def _systems_in(module: ModuleType) -> list[System]:
    """Systems that a module makes; those that it imports are known already."""
    known = list(systems().values())
    found = [item for _, item in inspect.getmembers(module) if isinstance(item, System)]
    return [item for item in found if not any(item is other for other in known)]


def _bases_in(module: ModuleType) -> list[type[AbstractBase]]:
    return [
        item
        for _, item in inspect.getmembers(module, inspect.isclass)
        if item.__module__ == module.__name__ and issubclass(item, AbstractBase) and not inspect.isabstract(item)
    ]


def _check_base(base: type[AbstractBase], path: Path) -> None:
    """Tries the base once, at parameters' starts in the middle of the state: a mistake is told now, not mid-fit."""
    label = f"{path}: class {base.__name__}"
    try:
        made = base()
        kind, system, parameters = made.kind, made.system, made.parameters
    except Exception as error:  # a user's class may fail in any way
        raise InputError(f"{label}: could not be made: {type(error).__name__}: {error}") from error
    known = systems().get(system.name)
    if known is not None and known.state_names != system.state_names:
        raise InputError(
            f"{label}: its system '{system.name}' has the states {', '.join(system.state_names)}, the known one of "
            f"that name {', '.join(known.state_names)}; choose another name"
        )
    state = dict.fromkeys(system.state_names, 0.1)
    action = dict.fromkeys(system.action_names, 0.1)
    try:
        rates = made.rates(state, action, {item.name: item.start for item in parameters}, FLOATS)
    except Exception as error:  # a user's equation may fail in any way
        raise InputError(f"{label}: rates: failed with {type(error).__name__}: {error}") from error
    if set(rates) != set(system.state_names):
        raise InputError(
            f"{label}: rates: got {', '.join(rates)}, wanted one rate for each state: {', '.join(system.state_names)} "
            f"(kind '{kind}')"
        )
