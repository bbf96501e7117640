"""Every robot that is known in this process, and what the lower layers may ask of one.

``Robot`` holds what can be stated with the types of this layer. ``safedpa.robot.AbstractRobot`` derives from it and
adds the types of models, barriers, controllers and messages; robots derive from that. A robot is a package of its own
in ``safedpa.robots``, one that another distribution brings by the entry point ``safedpa.robots``, or a class in a
Python file (``--robot-file``). Packages are found by name here, so that no layer imports a robot.
"""

from __future__ import annotations

import importlib
import pkgutil
from abc import ABC
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from importlib.metadata import EntryPoint
from typing import Any, ClassVar

from safedpa.barrier_setting import BarrierSetting
from safedpa.errors import InputError, did_you_mean
from safedpa.installed import entry_points_of_group
from safedpa.limits import readable
from safedpa.systems.system import System

DEFAULT_ROBOT: str = importlib.import_module("safedpa.robots").DEFAULT
"""The robot that is meant where none is named."""
ENTRY_POINTS = "safedpa.robots"
"""The group under which other distributions bring robots: name = "module:ROBOT"."""


class Robot(ABC):
    """One kind of robot, with the types of this layer; declare one by deriving from ``safedpa.robot.AbstractRobot``."""

    system: ClassVar[System]
    """Names, units and bounds of state and action."""
    rate: ClassVar[float]
    """Ticks per second at which it is driven."""
    variants: ClassVar[tuple[Robot, ...]] = ()
    """The same robot with another set of actions, such as a throttle in place of a speed; its model says which."""
    measurement_deviation: ClassVar[tuple[float, ...]]
    """(states,) standard deviation of what a measured state adds to one step, in the state's units."""
    smallest_motion: ClassVar[float] = 1.0
    """Measurement deviations by which some entry must change in a step for it to teach the adaptation anything."""
    command_timing: ClassVar[float] = 0.0
    """s by which its commands may act later than known, for what the adaptation learns soon after they change."""
    nominal_range: ClassVar[tuple[tuple[float, float], ...]] = ()
    """(actions, 2) lowest and highest of each action that its actuators can do; empty: the system's bounds."""
    can_stop: ClassVar[bool] = True
    """Whether the backup brings it to rest, and satisfies every condition meanwhile."""
    kinds: ClassVar[tuple[str, ...]] = ()
    """Kinds of its barriers: what margins may be called."""
    barrier_settings: ClassVar[tuple[BarrierSetting, ...]] = ()
    """Numbers that its barriers take from a settings file: clearances, what its brakes are good for."""
    calibrates_from_logs: ClassVar[bool] = False
    """Whether ``barriers_around`` draws barriers: then a margin can be had from logs that tell of no scene."""
    theorem_margins: ClassVar[bool] = False
    """Whether the theorem's margin is known for its barriers: how steep they are at most."""
    options: ClassVar[tuple[str, ...]] = ("world", "laser", "people")
    """Options of ``safedpa up`` that are its own: what may be asked of its simulated world."""
    default_controller: ClassVar[str] = "goal_seeker"
    """Which of ``controllers`` nominal actions where no one says, and no policy was learned."""
    stand_in_options: ClassVar[tuple[str, ...]] = ()
    """Options of the simulated robot's process that make it this variant."""

    effects_of_its_own: ClassVar[bool] = False
    """Whether all of ``effects`` are of its own system: then they are not loaded where another's are asked for."""

    model: Any
    """Default model; this and the methods below are as ``AbstractRobot`` declares them with the types of its layer."""
    bases: Callable[[], Mapping[str, Callable[..., Any]]]
    settings: Callable[[], Any]
    effects: Callable[[], Iterable[Any]]
    barriers: Callable[..., Any]
    barriers_around: Callable[..., Any]
    largest_gradients: Callable[..., Any]
    backup: Callable[..., Any]
    scene: Callable[..., Any]
    controllers: Callable[..., Any]
    learned: Callable[..., Any]
    frame: Callable[[], Any]
    perception: Callable[[], Any]
    simulator_export: Callable[..., Any]
    ros_face: Callable[..., Any]
    draw: Callable[..., Any]
    swept: Callable[..., Any]
    planar_body: Callable[..., Any]
    stand_in: Callable[..., Any]

    @property
    def name(self) -> str:
        """Of the system."""
        return self.system.name

    @property
    def settings_name(self) -> str:
        """Under which ``settings_named`` finds the settings of its filter."""
        return self.name

    def manoeuvres(self, t: Any) -> dict[str, tuple[Any, Any]]:
        """Drives that separate effects, by description: start (states,), actions (rows, actions) at times ``t`` [s].

        Empty: steps, holds and sweeps of each action are proposed.
        """
        return {}

    def of_system(self, system: System) -> Robot:
        """The variant that has these states and actions; the robot itself where none has."""
        wanted = _names(system)
        return next((one for one in (self, *self.variants) if _names(one.system) == wanted), self)


REGISTERED: dict[str, Robot] = {}
"""Robots that this process loaded from files outside the project, by name."""


def robots() -> dict[str, Robot]:
    """Every robot that is known in this process, by name."""
    return {**_shipped(), **REGISTERED}


def own_robots() -> tuple[str, ...]:
    """Names of those that files of one's own declared, in this process."""
    return tuple(REGISTERED)


def robot_named(name: str) -> Robot:
    """One robot. Raises InputError with the nearest names when there is none."""
    known = robots()
    if name not in known:
        shown = readable(name, 200)
        raise InputError(f"robot '{shown}': {did_you_mean(shown, known)}; --robot-file FILE.py loads one of your own")
    return known[name]


def robot_like(system: System) -> Robot | None:
    """The robot that has these states and actions, whatever the system is called; None: no one declared it.

    It may be a variant of one that ``robots`` lists.
    """
    wanted = _names(system)
    found = [one for robot in robots().values() for one in (robot, *robot.variants) if _names(one.system) == wanted]
    return next((one for one in found if one.name == system.name), found[0] if found else None)


def add_robot(robot: Robot) -> None:
    """Makes a robot known; the same name again replaces it. Raises InputError for the name of one that ships."""
    if robot.name in _shipped():
        raise InputError(f"robot '{robot.name}' ships with the project; choose another name for its system")
    REGISTERED[robot.name] = robot


def forget_robot(name: str) -> None:
    """Forgets a robot of one's own, if there is one. Raises InputError for the name of one that ships."""
    if name in _shipped():
        raise InputError(f"system '{name}' ships with the project; choose another name")
    REGISTERED.pop(name, None)


def _names(system: System) -> tuple[tuple[str, ...], tuple[str, ...]]:
    return system.state_names, system.action_names


@cache
def _shipped() -> dict[str, Robot]:
    package = importlib.import_module("safedpa.robots")
    inside = sorted(info.name for info in pkgutil.iter_modules(package.__path__, "safedpa.robots.") if info.ispkg)
    found: list[Any] = [importlib.import_module(name).ROBOT for name in inside]
    known = {robot.name: robot for robot in found}
    for point in entry_points_of_group(ENTRY_POINTS):
        robot = _brought(point)
        if robot.name in known:
            raise InputError(f"robot '{robot.name}' of {point.value}: is known already; uninstall one of the two")
        known[robot.name] = robot
    return known


def _brought(point: EntryPoint) -> Robot:
    """The robot of another distribution. Raises InputError where there is none behind its entry point."""
    try:
        robot = point.load()
    except Exception as error:  # another's module may fail in any way
        raise InputError(
            f"robot '{point.name}': {point.value} cannot be loaded: {type(error).__name__}: {error}; reinstall it"
        ) from error
    if not isinstance(robot, Robot):
        raise InputError(
            f"robot '{point.name}': got {type(robot).__name__} behind {point.value}, wanted an AbstractRobot"
        )
    return robot
