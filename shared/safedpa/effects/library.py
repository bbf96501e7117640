"""The library: all known effects by robot and name, including those that users load from a file."""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import pkgutil
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import ModuleType

from safedpa.effects.effect import AbstractEffect
from safedpa.effects.parameter import Parameter
from safedpa.errors import InputError, did_you_mean
from safedpa.installed import entry_points_of_group
from safedpa.systems import systems
from safedpa.systems.robots import Robot
from safedpa.systems.robots import robots as robots_declared

REGISTERED: dict[tuple[str, str], AbstractEffect] = {}
"""Effects that this process loaded from users' files, by robot and name."""


def effects_of(robot: str) -> dict[str, AbstractEffect]:
    """Returns the effects of one robot by name, in alphabetical order."""
    merged = {**_shipped(robot), **REGISTERED}
    return {name: item for (owner, name), item in sorted(merged.items()) if owner == robot}


def robots() -> tuple[str, ...]:
    """Returns the names of the robots that have effects, in alphabetical order."""
    return tuple(sorted({owner for owner, _ in {**_shipped(), **REGISTERED}}))


def effect(robot: str, name: str) -> AbstractEffect:
    """Returns one effect by name. Raises InputError with the nearest names if there is none."""
    known = effects_of(robot)
    if name in known:
        return known[name]
    owners = [owner for owner in robots() if name in effects_of(owner)]
    if owners:
        raise InputError(
            f"effect '{name}' belongs to robot '{owners[0]}', not to '{robot}': {did_you_mean(name, known)}"
        )
    raise InputError(f"effect '{name}' is not known for robot '{robot}': {did_you_mean(name, known)}")


def load_effects(path: Path) -> list[AbstractEffect]:
    """Adds the effects of a Python file to the library of this process, and returns them.

    Loading a file again replaces its effects. Raises InputError if the file cannot be run as Python, defines no effect
    or an incomplete one, or reuses a name of the library.
    """
    found = add_effects(module_from(path), path)
    if not found:
        raise InputError(
            f"{path}: got no effect, wanted a class derived from RateEffect, CommandEffect, FeltEffect or SensorEffect"
        )
    return found


def add_effects(module: ModuleType, path: Path) -> list[AbstractEffect]:
    """Adds the effects of a module, if any, and returns them. Raises InputError as ``load_effects``."""
    found = list(_effects_in(module))
    for item in found:
        _check_declaration(item, path)
        if (item.robot, item.name) in _shipped(item.robot):
            raise InputError(
                f"{path}: effect '{item.name}' of robot '{item.robot}' exists already; choose another name"
            )
    REGISTERED.update({(item.robot, item.name): item for item in found})
    return found


def _check_declaration(item: AbstractEffect, path: Path) -> None:
    label = f"{path}: class {type(item).__name__}"
    for attribute in ("name", "robot", "stage", "equation", "parameters", "signature", "source"):
        if not hasattr(item, attribute):
            raise InputError(f"{label}: attribute '{attribute}' is missing; give it in the class")
    if not item.name.isidentifier():
        raise InputError(f"{label}: name: got {item.name!r}, wanted letters, digits and underscores")
    if item.robot not in systems():
        raise InputError(f"{label}: robot: got {item.robot!r}; {did_you_mean(item.robot, systems())}")
    if not item.parameters or not all(isinstance(parameter, Parameter) for parameter in item.parameters):
        raise InputError(f"{label}: parameters: got {item.parameters!r}, wanted a tuple of Parameter(...)")


def _shipped(wanted: str = "") -> dict[tuple[str, str], AbstractEffect]:
    """Returns the effects that robots and installed modules declare: all, or at least those of one robot."""
    # importing the effects of all robots takes time that a service of one robot need not spend
    found = dict(_of_entry_points())
    for robot in robots_declared().values():
        if not wanted or wanted == robot.name or not robot.effects_of_its_own:
            found.update(_of_robot(robot))
    return found


@cache
def _of_robot(robot: Robot) -> dict[tuple[str, str], AbstractEffect]:
    return {(item.robot, item.name): item for item in robot.effects()}


@cache
def _of_entry_points() -> dict[tuple[str, str], AbstractEffect]:
    points = entry_points_of_group("safedpa.effects")
    return {(item.robot, item.name): item for entry in points for item in _effects_in(entry.load())}


def effects_in_package(name: str) -> tuple[AbstractEffect, ...]:
    """Returns the effects that a module, or the modules of a package by their names, define."""
    package = importlib.import_module(name)
    inside = pkgutil.iter_modules(getattr(package, "__path__", ()), name + ".")
    modules = [package, *(importlib.import_module(info.name) for info in inside)]
    return tuple(item for module in modules for item in _effects_in(module))


def _effects_in(module: ModuleType) -> Iterator[AbstractEffect]:
    for _, member in inspect.getmembers(module, inspect.isclass):
        own = member.__module__ == module.__name__  # not the base classes that it imports
        if own and issubclass(member, AbstractEffect) and not inspect.isabstract(member):
            yield member()
    for several in vars(module).values():  # tables such as EFFECTS = general_effects(...)
        if isinstance(several, (list, tuple)):
            yield from (item for item in several if isinstance(item, AbstractEffect))


def module_from(path: Path) -> ModuleType:
    """Runs a user's Python file and returns the module. Raises InputError if that fails."""
    name = f"safedpa_own_effects_{path.stem}"
    specification = importlib.util.spec_from_file_location(name, path)
    if not path.is_file() or specification is None or specification.loader is None:
        raise InputError(f"{path}: got no Python file, wanted one that defines effects or a robot, such as my_robot.py")
    module = importlib.util.module_from_spec(specification)
    sys.modules[name] = module  # before it runs: dataclasses and pickle look a class's module up there
    try:
        specification.loader.exec_module(module)
    except (Exception, SystemExit) as error:  # a user's file may fail in any way, or end as a program does
        raise InputError(f"{path}: could not be run: {type(error).__name__}: {error}") from error
    return module
