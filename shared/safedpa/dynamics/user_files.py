"""Loads a user's robots, systems, base models and effects from a Python file.

Files are named by an option, or by the environment variable SAFEDPA_EFFECTS (several, separated by the path separator),
which child processes inherit. An entry point ``safedpa.effects`` names a module of an installed distribution.
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
from safedpa.dynamics.base import AbstractBase, add_base
from safedpa.effects.library import add_effects, module_from
from safedpa.errors import InputError
from safedpa.installed import entry_points_of_group
from safedpa.limits import finite_number
from safedpa.operations import FLOATS
from safedpa.systems import System, add_system, systems
from safedpa.systems.robots import Robot, add_robot

_DECLARED = ("system", "rate", "measurement_deviation")
"""Attributes that a robot must have next to its abstract methods."""

EFFECTS_VARIABLE = "SAFEDPA_EFFECTS"
"""Name of the environment variable."""


def load_user_file(path: Path) -> list[str]:
    """Loads a file, and returns the names of what it added: robots, systems, base models, effects.

    Raises InputError if it cannot be run as Python, defines nothing, or defines something incomplete.
    """
    found = _added(module_from(path), path)
    if not found:
        raise InputError(
            f"{path}: got no effect, wanted a class derived from RateEffect, CommandEffect, FeltEffect or "
            "SensorEffect, a System, a base model, or a robot"
        )
    return found


def load_user_file_everywhere(path: Path) -> list[str]:
    """Loads a file as ``load_user_file``, in this process and in all that it starts."""
    found = load_user_file(path)
    # the absolute path: a child process may run in another folder
    known = [item for item in os.environ.get(EFFECTS_VARIABLE, "").split(os.pathsep) if item]
    os.environ[EFFECTS_VARIABLE] = os.pathsep.join(dict.fromkeys([*known, str(path.resolve())]))
    return found


def load_user_files() -> None:
    """Loads the files of the environment variable and the modules of the entry points, each once per process."""
    for name in os.environ.get(EFFECTS_VARIABLE, "").split(os.pathsep):
        if name:
            _loaded_once(name)
    _entry_points_once()


@cache
def _loaded_once(name: str) -> tuple[str, ...]:
    return tuple(load_user_file(Path(name)))


@cache
def _entry_points_once() -> None:
    """Registers systems and base models of installed modules; the library loads their effects itself."""
    for entry in entry_points_of_group("safedpa.effects"):
        module = entry.load()
        for item in _systems_in(module):
            add_system(item)
        for base in _bases_in(module):
            add_base(base)


def _added(module: ModuleType, path: Path) -> list[str]:
    # in this order: a base model needs its system, an effect its robot
    robots_found = _robots_in(module, path)
    try:
        for robot in robots_found:
            add_robot(robot)
        own = _systems_in(module)
        for system in own:
            add_system(system)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    bases = _bases_in(module)
    for base in bases:
        _check_base(base, path)
        # a robot declares its own base models: registering them again would shadow them
        if base not in [made for robot in robots_found for made in robot.bases().values()]:
            add_base(base)
    names = [*(item.name for item in robots_found), *(item.name for item in own), *(item.kind for item in bases)]
    return [*names, *(item.name for item in add_effects(module, path))]


def _robots_in(module: ModuleType, path: Path) -> list[Robot]:
    """Returns an instance of each robot class of a module. Raises InputError for an incomplete one."""
    found = []
    for name, item in inspect.getmembers(module, inspect.isclass):
        # classes that the file imports are not its own
        if item.__module__ != module.__name__ or not issubclass(item, Robot):
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


def _check_declared(robot: Robot, bases: Any, label: str) -> None:
    """Raises InputError for declarations that would otherwise fail far from the user's file."""
    if not isinstance(robot.system, System):
        raise InputError(f"{label}: system: got {type(robot.system).__name__}, wanted a System")
    kinds: Any = robot.kinds
    if finite_number(f"{label}: rate", robot.rate) <= 0.0:
        raise InputError(f"{label}: rate: got {robot.rate}, wanted ticks a second, more than 0")
    if isinstance(kinds, str):  # a missing comma: it would be taken for a tuple of letters
        raise InputError(f"{label}: kinds: got '{kinds}', wanted a tuple of names, such as ('{kinds}',)")
    if not isinstance(robot.barrier_settings, (tuple, list)) or not all(
        isinstance(item, BarrierSetting) for item in robot.barrier_settings
    ):
        raise InputError(f"{label}: barrier_settings: got {robot.barrier_settings!r}, wanted a tuple of BarrierSetting")
    if not isinstance(bases, Mapping) or not all(map(callable, bases.values())):
        raise InputError(f"{label}: bases: got {bases!r}, wanted a table of base models by kind: {{'kind': Class}}")


def _systems_in(module: ModuleType) -> list[System]:
    """Returns the systems that a module defines; those that it imports are registered already."""
    known = list(systems().values())
    found = [item for _, item in inspect.getmembers(module) if isinstance(item, System)]
    # by identity: a user's system may equal a shipped one, and the registry then says that the name is taken
    return [item for item in found if not any(item is other for other in known)]


def _bases_in(module: ModuleType) -> list[type[AbstractBase]]:
    return [
        item
        for _, item in inspect.getmembers(module, inspect.isclass)
        if item.__module__ == module.__name__ and issubclass(item, AbstractBase) and not inspect.isabstract(item)
    ]


def _check_base(base: type[AbstractBase], path: Path) -> None:
    """Evaluates the base once, so that a mistake is reported now and not during a fit. Raises InputError."""
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
    # not 0: an equation that divides by a speed is valid, but would fail for a robot at rest
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
