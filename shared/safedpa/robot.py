"""What is known of one kind of robot, in one place: how it is declared, and how it is found.

A robot is a class derived from ``AbstractRobot``: a package of its own in ``safedpa.robots``, one that another
distribution brings by the entry point ``safedpa.robots``, or one Python file (``--robot-file``). Everything generic
asks here for what differs from robot to robot, and for no name. Whatever is heavy is imported within the method that
needs it: to know a robot costs nothing.
"""

from __future__ import annotations

import importlib
import pkgutil
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from importlib.metadata import EntryPoint
from typing import TYPE_CHECKING, Any, ClassVar

from safedpa.errors import InputError, did_you_mean
from safedpa.installed import entry_points_of_group
from safedpa.limits import readable

if TYPE_CHECKING:
    from pathlib import Path

    import numpy as np
    from numpy.typing import ArrayLike, NDArray

    from safedpa.barrier_setting import BarrierSetting
    from safedpa.bus import StateMessage
    from safedpa.drawing import Shape
    from safedpa.dynamics import AbstractBase, AbstractDynamics, PhysicsModel
    from safedpa.dynamics.elsewhere import SimulatorExport
    from safedpa.effects import AbstractEffect
    from safedpa.networks.frame import Frame
    from safedpa.policy.controller import Controller
    from safedpa.policy.perception import ObservationModel
    from safedpa.ros.face import AbstractFace
    from safedpa.runtime.scene import AbstractScene
    from safedpa.safety.barriers.base import AbstractBarrier
    from safedpa.safety.settings import FilterSettings
    from safedpa.stand_in import AbstractStandIn
    from safedpa.systems import System

__all__ = [
    "DEFAULT_ROBOT",
    "ENTRY_POINTS",
    "REGISTERED",
    "AbstractRobot",
    "add_robot",
    "forget_robot",
    "own_robots",
    "robot_like",
    "robot_named",
    "robots",
]

DEFAULT_ROBOT: str = importlib.import_module("safedpa.robots").DEFAULT
"""What is meant where no one says which."""
ENTRY_POINTS = "safedpa.robots"
"""The group under which other distributions bring robots: name = "module:ROBOT"."""


class AbstractRobot(ABC):
    """One kind of robot. What is abstract must be declared; the rest has a default that fits a robot without it."""

    system: ClassVar[System]
    """Names, units and bounds of state and action."""
    rate: ClassVar[float]
    """Ticks per second at which it is driven."""
    variants: ClassVar[tuple[AbstractRobot, ...]] = ()
    """The same robot with another set of actions, such as a throttle in place of a speed; its model tells which."""
    measurement_deviation: ClassVar[tuple[float, ...]]
    """(states,) standard deviation of what a measured state adds to one step, in the state's units."""
    smallest_motion: ClassVar[float] = 1.0
    """Measurement deviations by which some entry must change in a step for it to teach the adaptation anything."""
    nominal_range: ClassVar[tuple[tuple[float, float], ...]] = ()
    """(actions, 2) lowest and highest of each action that its actuators can do; empty: the system's bounds."""
    stationary_for: ClassVar[bool] = True
    """Whether the backup brings it to rest, and satisfies every condition meanwhile."""
    kinds: ClassVar[tuple[str, ...]] = ()
    """Kinds of its barriers: what margins may be called."""
    barrier_settings: ClassVar[tuple[BarrierSetting, ...]] = ()
    """Numbers that its barriers take from a settings file: clearances, what its brakes are good for."""
    calibrates_from_logs: ClassVar[bool] = False
    """Whether ``barriers_around`` draws barriers: then a margin can be had from logs that tell of no scene."""
    theorem_margins: ClassVar[bool] = False
    """Whether the theorem's margin is known for its barriers: how steep they are at most."""
    options: ClassVar[tuple[str, ...]] = ("world",)
    """Options of ``safedpa up`` that are its own: what may be asked of its simulated world."""
    default_controller: ClassVar[str] = "goal_seeker"
    """Which of ``controllers`` nominal actions where no one says, and no policy was learned."""
    stand_in_options: ClassVar[tuple[str, ...]] = ()
    """Options of the simulated robot's process that make it this variant."""

    effects_of_its_own: ClassVar[bool] = False
    """Whether all of ``effects`` are of its own system: then they are not loaded where another's are asked for."""

    @property
    def name(self) -> str:
        """Of the system."""
        return self.system.name

    @property
    def settings_name(self) -> str:
        """Under which ``settings_named`` finds the settings of its filter."""
        return self.name

    def of_system(self, system: System) -> AbstractRobot:
        """The variant that has these states and actions; the robot itself where none has."""
        wanted = _names(system)
        return next((one for one in (self, *self.variants) if _names(one.system) == wanted), self)

    @property
    @abstractmethod
    def model(self) -> str | Path:
        """The model that it is driven with where no one names one: a file, or the name of one that ships."""

    @abstractmethod
    def bases(self) -> Mapping[str, Callable[..., AbstractBase]]:
        """What makes its base models, by kind; classes take their ``choices`` by name."""

    @abstractmethod
    def settings(self) -> FilterSettings:
        """Settings of its filter, with the bounds of its actions."""

    def effects(self) -> Iterable[AbstractEffect]:
        """What its base models may lack."""
        return ()

    def barriers(
        self, state: StateMessage, model: AbstractDynamics, latent: NDArray[np.float64] | None, settings: FilterSettings
    ) -> Sequence[AbstractBarrier]:
        """The barriers around it, from what it measures and perceives now; at least one, whatever it perceives.

        Without any the filter has nothing to judge by, and the backup acts: limits of speed or walls are always there.
        ``latent`` (latents,) is the newest, None before there is one. Raises InputError for what cannot be a scene of
        this robot: then the backup acts, and the verdict says why.
        """
        raise InputError(f"robot '{self.name}': it declares no barriers; write its method 'barriers'")

    def barriers_around(
        self,
        state: NDArray[np.float64],
        settings: FilterSettings,
        footprint: tuple[float, ...],
        draw: np.random.Generator,
    ) -> Sequence[AbstractBarrier]:
        """Barriers as they might be at a recorded ``state`` (states,), drawn: for margins from logs without a scene."""
        del state, settings, footprint, draw
        return ()

    def largest_gradients(
        self, settings: FilterSettings, footprint: Sequence[float], scale: NDArray[np.float64]
    ) -> Mapping[str, float]:
        """By kind of barrier the largest |d(h)/d(v)|_1 over increments v (states,) of that ``scale``, in its own frame.

        Asked for where ``theorem_margins`` says that it is known.
        """
        raise NotImplementedError(f"robot '{self.name}': how steep its barriers are at most is not known")

    def backup(self, state: NDArray[np.float64], model: AbstractDynamics, settings: FilterSettings) -> ArrayLike:
        """The action (actions,) that is taken when nothing else is known to be safe, at ``state`` (states,)."""
        del state, model
        return settings.resting_action

    def scene(self, model: AbstractDynamics, settings: FilterSettings) -> AbstractScene | None:
        """What keeps the barriers from tick to tick; None: they are built again from ``barriers`` in each.

        Raises InputError for a model or settings of another robot.
        """
        del model, settings
        return None

    def controllers(self, model: PhysicsModel) -> Mapping[str, Callable[[], Controller]]:
        """What makes its own controllers, by name; ``random`` and ``learned`` every robot has."""
        del model
        return {}

    def learned(self, policy: Controller) -> Controller:
        """A learned policy as this robot drives it: what else it does when it is stuck."""
        return policy

    def frame(self) -> Frame | None:
        """What its networks see of the state; None: it has no networks."""
        return None

    def perception(self) -> ObservationModel | None:
        """What its learned policy observes; None: it has none."""
        return None

    def elsewhere(self, model: PhysicsModel) -> SimulatorExport | None:
        """The model in the words of other simulators; None: its table of parameters alone."""
        del model
        return None

    def ros_face(self, model: AbstractDynamics | None = None) -> AbstractFace | None:
        """How it shows itself to ROS, with the measures of ``model`` where one is named; None: states as numbers."""
        del model
        return None

    def draw(self, state: StateMessage) -> Mapping[str, Shape]:
        """The robot itself as plain shapes, by the name of each; empty: curves alone."""
        del state
        return {}

    def swept(self, state: StateMessage, settings: FilterSettings) -> tuple[float, float, float] | None:
        """Of the capsule that its barriers keep free now: rear end, front end along the heading, and radius [m]."""
        del state, settings
        return None

    def stand_in(self, seed: int, given: Mapping[str, float]) -> AbstractStandIn:
        """A simulated robot to drive instead of the real one; ``given``: what was asked of its world, by name.

        Raises InputError for what its world does not have, and where there is none.
        """
        raise InputError(f"robot '{self.name}': it has no simulated stand-in; run a robot of your own (docs/bus.md)")


REGISTERED: dict[str, AbstractRobot] = {}
"""Robots that this process loaded from files outside the project, by name."""


def robots() -> dict[str, AbstractRobot]:
    """Every robot that is known in this process, by name."""
    return {**_shipped(), **REGISTERED}


def own_robots() -> tuple[str, ...]:
    """Names of those that files of one's own declared, in this process."""
    return tuple(REGISTERED)


def robot_named(name: str) -> AbstractRobot:
    """One robot. Raises InputError with the nearest names when there is none."""
    known = robots()
    if name not in known:
        shown = readable(name, 200)
        raise InputError(f"robot '{shown}': {did_you_mean(shown, known)}; --robot-file FILE.py loads one of your own")
    return known[name]


def robot_like(system: System) -> AbstractRobot | None:
    """The robot that has these states and actions, whatever the system is called; None: no one declared it.

    It may be a variant of one that ``robots`` lists.
    """
    wanted = _names(system)
    found = [one for robot in robots().values() for one in (robot, *robot.variants) if _names(one.system) == wanted]
    return next((one for one in found if one.name == system.name), found[0] if found else None)


def add_robot(robot: AbstractRobot) -> None:
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
def _shipped() -> dict[str, AbstractRobot]:
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


def _brought(point: EntryPoint) -> AbstractRobot:
    """The robot of another distribution. Raises InputError where there is none behind its entry point."""
    try:
        robot = point.load()
    except Exception as error:  # another's module may fail in any way
        raise InputError(
            f"robot '{point.name}': {point.value} cannot be loaded: {type(error).__name__}: {error}; reinstall it"
        ) from error
    if not isinstance(robot, AbstractRobot):
        raise InputError(
            f"robot '{point.name}': got {type(robot).__name__} behind {point.value}, wanted an AbstractRobot"
        )
    return robot
