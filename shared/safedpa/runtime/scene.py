"""Scenes: they build the barriers around one robot from its state messages.

``scene_of`` finds the scene of a robot by the states and actions of its model. ``propagate_obstacles`` enlarges moving
obstacles by the distance that they may travel before an action takes effect.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final, final

from safedpa.arrays import FloatArray
from safedpa.bus import StateMessage, SurroundingsMessage
from safedpa.dynamics import AbstractDynamics
from safedpa.errors import InputError, described
from safedpa.runtime.planar_scene import PlanarSensing
from safedpa.safety.barriers.base import AbstractBarrier, AbstractBarrierSet, CachingBarrierSet
from safedpa.safety.barriers.stack import make_barrier_set
from safedpa.safety.checks.compatibility import check_margins, check_reads, check_settings
from safedpa.safety.decision import Backup
from safedpa.safety.settings import FilterSettings
from safedpa.systems import System
from safedpa.systems.robots import Robot, robot_like, robots

MOST_OBSTACLES: Final = 64
"""Maximum number of obstacles. With 64, a decision takes 5 ms at worst; with a thousand nearby ones it would take three
seconds, in which the other robots of the fleet would get no action."""


NO_SENSES: Final = "this robot's barriers take no sensors; declare its planar_body, or leave the sensors out"
"""Why a robot with sensors would get the backup action in every tick."""


class AbstractScene(ABC):
    """Builds the barriers around one robot."""

    senses: bool = False
    """Whether it builds barriers from sensors: whether ``around`` works."""
    can_stop: bool = True
    """Whether the backup action brings the robot to rest."""
    quick: bool = False
    """Whether h is cheap enough to evaluate at hundreds of states per tick."""
    yields_to: str = ""
    """Description of a moving object that may reach the robot before it has stopped, as of the last ``around``; empty:
    none. The backup action is then taken immediately, because a robot must not evade moving objects, but stop."""
    remark: str = ""
    """Sentence about the barriers of the last ``around`` for the verdict; empty: none."""
    backup: Backup | None = None
    """The backup action at a state; None: the resting action of the settings."""

    def prepare(self) -> None:  # noqa: B027 - optional
        """Loads what is compiled of the barriers; it takes a tick and would delay the first decision."""

    @abstractmethod
    def of(self, state: StateMessage) -> AbstractBarrierSet | str:
        """Returns the barriers around this robot, or a description of what is wrong with the state."""

    def around(
        self,
        state: StateMessage,
        seen: SurroundingsMessage,
        epsilon: Mapping[str, float] | None = None,
        late: float = 0.0,
    ) -> AbstractBarrierSet | str:
        """Returns the barriers around a robot with sensors from its surroundings, or a description of a problem.

        ``epsilon`` has the active margins by kind; ``late`` [s] passes until an action acts. Both determine which
        objects are too far away to matter.
        """
        return f"scene (sources {', '.join(state.sources)}: {NO_SENSES})"

    def follow(self, state: StateMessage) -> None:
        """Updates the odometry from a state; idempotent for a repeated state."""
        del state

    def learn(self, latent: FloatArray | None) -> None:
        """Sets the latent used last; None: the model's own."""
        del latent

    def remember(self, former: AbstractScene) -> None:
        """Takes over the odometry of the scene of the previous model."""
        del former


@final
class DeclaredScene(AbstractScene):
    """The barriers that a robot declares. If the robot's code raises an exception, the backup acts."""

    def __init__(self, robot: Robot, model: AbstractDynamics, settings: FilterSettings) -> None:
        self._robot, self._model, self._settings = robot, model, settings
        self._own: tuple[AbstractBarrier, ...] = ()
        self._latent: FloatArray | None = None
        self.can_stop = robot.can_stop
        self.backup = self._backup
        body = robot.planar_body(model, settings)
        self._sensing = None if body is None else PlanarSensing(body, model, settings)
        self.senses = body is not None

    def learn(self, latent: FloatArray | None) -> None:  # noqa: D102
        self._latent = latent
        if self._sensing is not None:
            self._sensing.learn(latent)

    def around(  # noqa: D102
        self,
        state: StateMessage,
        seen: SurroundingsMessage,
        epsilon: Mapping[str, float] | None = None,
        late: float = 0.0,
    ) -> AbstractBarrierSet | str:
        if self._sensing is None:
            return super().around(state, seen, epsilon, late)
        try:
            sensed = self._sensing.barriers(state, seen, epsilon, late)
        except InputError as error:
            return f"surroundings ({error})"
        # Its own barriers say nothing about obstacles here: those, and the walls, are what the sensors report.
        own = self.of(replace(state, obstacles=(), field=(), sources=()))
        if isinstance(own, str):
            return own
        self.yields_to, self.remark = self._sensing.yields_to, self._sensing.remark
        return CachingBarrierSet(make_barrier_set((*sensed, *self._own)))

    def of(self, state: StateMessage) -> AbstractBarrierSet | str:  # noqa: D102
        if len(state.obstacles) > MOST_OBSTACLES:
            return f"scene (obstacles: got {len(state.obstacles)}, wanted at most {MOST_OBSTACLES}; send the nearest)"
        try:
            parts = tuple(self._robot.barriers(state, self._model, self._latent, self._settings))
            check_reads(parts, self._model.system.state_names)
        except InputError as error:
            return f"scene ({error})"
        except Exception as error:  # noqa: BLE001
            # A robot's own code may raise anything. The sentence goes into the verdict, and the backup acts.
            return f"scene (barriers of robot '{self._robot.name}': {described(error)})"
        self._own = parts
        return CachingBarrierSet(make_barrier_set(parts))

    def _backup(self, state: FloatArray | None) -> Any:
        """Returns the robot's backup action; the resting action if the state is unknown."""
        if state is None:
            return self._settings.resting_action
        return self._robot.backup(state, self._model, self._settings)


def scene_of(model: AbstractDynamics, settings: FilterSettings) -> AbstractScene:
    """Returns the scene for a robot with this model.

    Raises InputError for a robot without barriers, settings of another robot, or margins of unknown kinds.
    """
    robot = robot_like(model.system)
    if robot is None:
        raise InputError(_no_names(model.system))
    check_settings(settings, model.system)
    scene = robot.scene(model, settings) or DeclaredScene(robot, model, settings)
    check_margins(settings.epsilon, ())
    return scene


def check_senses(model: AbstractDynamics, settings: FilterSettings, wanted: str) -> None:
    """Raises InputError if a robot with this model takes no sensors; ``wanted`` names what asks for them."""
    if not scene_of(model, settings).senses:
        raise InputError(f"{wanted}: got sensors for the robot '{model.system.name}', but {NO_SENSES}")


def _no_names(system: System) -> str:
    known = [one.system for one in robots().values()]
    reported = "; ".join(f"{', '.join(item.state_names)} with {', '.join(item.action_names)}" for item in known)
    return (
        f"model: no barriers for the system '{system.name}', {', '.join(system.state_names)} with "
        f"{', '.join(system.action_names) or 'no action'}; the service has barriers for {reported}; declare your own "
        "robot with --robot-file, or use the library with your own barriers"
    )


def propagate_obstacles(seen: SurroundingsMessage, seconds: float) -> SurroundingsMessage:
    """Enlarges everything that may move by the distance it may travel in ``seconds``, until an action takes effect."""
    if seconds <= 0.0:
        return seen

    def enlarged(row: tuple[float, ...], width: int) -> tuple[float, ...]:
        # (x, y, radius, ..., speed). A row of another width is left as it is; the scene reports the error.
        return row if len(row) != width else (*row[:2], row[2] + row[-1] * seconds, *row[3:])

    movers, hidden = (enlarged(row, 6) for row in seen.movers), (enlarged(row, 4) for row in seen.hidden)
    return replace(seen, movers=tuple(movers), hidden=tuple(hidden))
