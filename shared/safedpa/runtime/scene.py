"""A scene: the barriers around one robot, from its state messages, kept for as long as nothing changes.

What builds the barriers around a robot: the robot's own, found by the states and actions of its model.

What may move, as far as it can have come by the time an action that is chosen now begins to act.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final, final

from safedpa.arrays import FloatArray
from safedpa.bus import StateMessage, SurroundingsMessage
from safedpa.dynamics import AbstractDynamics
from safedpa.errors import InputError
from safedpa.robot import AbstractRobot, robot_like, robots
from safedpa.safety.barriers.base import AbstractBarrierSet, CachingBarrierSet
from safedpa.safety.barriers.stack import make_barrier_set
from safedpa.safety.checks.compatibility import check_margins, check_reads, check_settings
from safedpa.safety.decision import Backup
from safedpa.safety.settings import FilterSettings
from safedpa.systems import System

__all__ = [
    "MOST_OBSTACLES",
    "AbstractScene",
    "DeclaredScene",
    "propagate_obstacles",
    "scene_of",
]


MOST_OBSTACLES: Final = 64
"""A decision about so many takes 5 ms at the worst; a thousand, all of them at hand, take three seconds, in
which the other robots of the fleet would get no action."""


class AbstractScene(ABC):
    """The barriers around one robot."""

    stationary_for: bool = True
    """Whether the backup action brings the robot to rest."""
    quick: bool = False
    """Whether its h is cheap enough to be asked at hundreds of states in a tick."""
    yields_to: str = ""
    """Who may be at the robot before it stands, as of the last ``around``: then the backup is taken at once, since what
    moves by itself may not be dodged but by standing. Empty: no one."""
    remark: str = ""
    """What a verdict has to say about the barriers of the last ``around``; empty: nothing."""
    backup: Backup | None = None
    """The backup action at a state; None: the resting action of the settings."""

    @abstractmethod
    def of(self, state: StateMessage) -> AbstractBarrierSet | str:
        """The barriers around this robot, or a sentence about what cannot be a scene of it."""

    def around(
        self,
        state: StateMessage,
        seen: SurroundingsMessage,
        epsilon: Mapping[str, float] | None = None,
        late: float = 0.0,
    ) -> AbstractBarrierSet | str:
        """The barriers around a robot that names sources, from what they see; or why there are none.

        ``epsilon`` are the margins in force by kind, ``late`` [s] passes until an action acts: from both follows what
        is too far to matter.
        """
        del seen, epsilon, late
        return f"scene (sources {', '.join(state.sources)}: this robot has barriers for what is told alone)"

    def follow(self, state: StateMessage) -> None:
        """What a state tells of the robot's own way, whatever is around it; the same state twice changes nothing."""
        del state

    def learn(self, latent: FloatArray | None) -> None:
        """The latent that was used last; None: that of the model's file."""
        del latent

    def remember(self, former: AbstractScene) -> None:
        """Takes over what the scene of the model before this one knew of the robot."""
        del former


@final
class DeclaredScene(AbstractScene):
    """The barriers that a robot declares, built again where its message or the latent changed.

    Whatever the robot's own code raises is a sentence, and the backup acts.
    """

    def __init__(self, robot: AbstractRobot, model: AbstractDynamics, settings: FilterSettings) -> None:
        self._robot, self._model, self._settings = robot, model, settings
        self._latent: FloatArray | None = None
        self.stationary_for = robot.stationary_for
        self.backup = self._backup

    def around(
        self,
        state: StateMessage,
        seen: SurroundingsMessage,
        epsilon: Mapping[str, float] | None = None,
        late: float = 0.0,
    ) -> AbstractBarrierSet | str:
        """The barriers around a robot that names sources, from what they see; or why there are none.

        ``epsilon`` are the margins in force by kind, ``late`` [s] passes until an action acts: from both follows what
        is too far to matter.
        """
        del seen, epsilon, late
        return f"scene (sources {', '.join(state.sources)}: this robot has barriers for what is told alone)"

    def learn(self, latent: FloatArray | None) -> None:  # noqa: D102
        self._latent = latent

    def of(self, state: StateMessage) -> AbstractBarrierSet | str:  # noqa: D102
        if len(state.obstacles) > MOST_OBSTACLES:
            return f"scene (obstacles: got {len(state.obstacles)}, wanted at most {MOST_OBSTACLES}; send the nearest)"
        try:
            parts = tuple(self._robot.barriers(state, self._model, self._latent, self._settings))
            check_reads(parts, self._model.system.state_names)
        except InputError as error:
            return f"scene ({error})"
        except Exception as error:  # noqa: BLE001 - a robot's own code may raise anything; the backup acts then
            return f"scene (barriers of robot '{self._robot.name}': {type(error).__name__}: {error})"
        return CachingBarrierSet(make_barrier_set(parts))

    def _backup(self, state: FloatArray | None) -> Any:
        """The resting action where the state is not known; the filter takes it as well where this raises."""
        if state is None:
            return self._settings.resting_action
        return self._robot.backup(state, self._model, self._settings)


def scene_of(model: AbstractDynamics, settings: FilterSettings) -> AbstractScene:
    """The barriers' builder for one robot.

    Raises InputError for a robot whose barriers no one wrote, settings of another one, or margins of unknown kinds.
    """
    robot = robot_like(model.system)
    if robot is None:
        raise InputError(_no_names(model.system))
    check_settings(settings, model.system)
    scene = robot.scene(model, settings) or DeclaredScene(robot, model, settings)
    check_margins(settings.epsilon, ())
    return scene


def _no_names(system: System) -> str:
    known = [one.system for one in robots().values()]
    reported = "; ".join(f"{', '.join(item.state_names)} with {', '.join(item.action_names)}" for item in known)
    return (
        f"model: of the system '{system.name}', {', '.join(system.state_names)} with "
        f"{', '.join(system.action_names) or 'no action'}; the service has barriers for {reported}; declare a robot of "
        "your own (--robot-file), or filter it with the library, which takes barriers of your own"
    )


Rows = tuple[tuple[float, ...], ...]


def propagate_obstacles(seen: SurroundingsMessage, seconds: float) -> SurroundingsMessage:
    """What may move, wider by what it goes before an action that is chosen now begins to act."""
    if seconds <= 0.0:
        return seen
    movers, hidden = (tuple(_inflated(row, width, seconds) for row in rows) for rows, width in _propagated(seen))
    return replace(seen, movers=movers, hidden=hidden)


def _propagated(seen: SurroundingsMessage) -> tuple[tuple[Rows, int], tuple[Rows, int]]:
    """Rows x, y, radius, ..., speed of what may move, with how many numbers each has to have."""
    return (seen.movers, 6), (seen.hidden, 4)


def _inflated(row: tuple[float, ...], width: int, seconds: float) -> tuple[float, ...]:
    """Of a row of another width the scene says that it has one."""
    return row if len(row) != width else (*row[:2], row[2] + row[-1] * seconds, *row[3:])
