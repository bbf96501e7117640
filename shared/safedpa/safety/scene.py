"""A scene: the barriers around one robot, from its state messages, kept for as long as nothing changes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, Final, final

import numpy as np
from numpy.typing import NDArray

from safedpa.bus import StateMessage, SurroundingsMessage
from safedpa.dynamics import AbstractDynamics
from safedpa.errors import InputError
from safedpa.robot import AbstractRobot
from safedpa.safety.barrier import AbstractStack, RememberingStack
from safedpa.safety.compatibility import check_reads
from safedpa.safety.decision import Backup
from safedpa.safety.settings import FilterSettings
from safedpa.safety.stacks import stacked

__all__ = ["MOST_OBSTACLES", "AbstractScene", "DeclaredScene"]

Values = NDArray[np.float64]

MOST_OBSTACLES: Final = 64
"""A decision about so many takes 5 ms at the worst; a thousand, all of them at hand, take three seconds, in
which the other robots of the fleet would get no action."""


class AbstractScene(ABC):
    """The barriers around one robot."""

    stands: bool = True
    """Whether the backup action brings the robot to rest."""
    quick: bool = False
    """Whether its h is cheap enough to be asked at hundreds of states in a tick."""
    yields_to: str = ""
    """Who may be at the robot before it stands, as of the last ``around``: then the backup is taken at once, since what
    moves by itself may not be dodged but by standing. Empty: nobody."""
    remark: str = ""
    """What a verdict has to say about the barriers of the last ``around``; empty: nothing."""
    backup: Backup | None = None
    """The backup action at a state; None: the resting action of the settings."""

    @abstractmethod
    def of(self, state: StateMessage) -> AbstractStack | str:
        """The barriers around this robot, or a sentence about what cannot be a scene of it."""

    def around(
        self,
        state: StateMessage,
        seen: SurroundingsMessage,
        epsilon: Mapping[str, float] | None = None,
        late: float = 0.0,
    ) -> AbstractStack | str:
        """The barriers around a robot that names sources, from what they see; or why there are none.

        ``epsilon`` are the margins in force by kind, ``late`` [s] passes until an action acts: from both follows what
        is too far to matter.
        """
        del seen, epsilon, late
        return f"scene (sources {', '.join(state.sources)}: this robot has barriers for what is told alone)"

    def follow(self, state: StateMessage) -> None:
        """What a state tells of the robot's own way, whatever is around it; the same state twice changes nothing."""
        del state

    def learn(self, latent: Values | None) -> None:
        """The latent that was used last; None: that of the model's file."""
        del latent

    def remember(self, former: AbstractScene) -> None:
        """Takes over what the scene of the model before this one knew of the robot."""
        del former


@final
class DeclaredScene(AbstractScene):
    """The barriers that a robot declares, built anew where its message or the latent changed.

    Whatever the robot's own code raises is a sentence, and the backup acts.
    """

    def __init__(self, robot: AbstractRobot, model: AbstractDynamics, settings: FilterSettings) -> None:
        self._robot, self._model, self._settings = robot, model, settings
        self._latent: Values | None = None
        self.stands = robot.stands
        self.backup = self._backup

    def around(
        self,
        state: StateMessage,
        seen: SurroundingsMessage,
        epsilon: Mapping[str, float] | None = None,
        late: float = 0.0,
    ) -> AbstractStack | str:
        """The barriers around a robot that names sources, from what they see; or why there are none.

        ``epsilon`` are the margins in force by kind, ``late`` [s] passes until an action acts: from both follows what
        is too far to matter.
        """
        del seen, epsilon, late
        return f"scene (sources {', '.join(state.sources)}: this robot has barriers for what is told alone)"

    def learn(self, latent: Values | None) -> None:  # noqa: D102
        self._latent = latent

    def of(self, state: StateMessage) -> AbstractStack | str:  # noqa: D102
        if len(state.obstacles) > MOST_OBSTACLES:
            return f"scene (obstacles: got {len(state.obstacles)}, wanted at most {MOST_OBSTACLES}; send the nearest)"
        try:
            parts = tuple(self._robot.barriers(state, self._model, self._latent, self._settings))
            check_reads(parts, self._model.system.state_names)
        except InputError as error:
            return f"scene ({error})"
        except Exception as error:  # noqa: BLE001 - a robot's own code may raise anything; the backup acts then
            return f"scene (barriers of robot '{self._robot.name}': {type(error).__name__}: {error})"
        return RememberingStack(stacked(parts))

    def _backup(self, state: Values | None) -> Any:
        """The resting action where the state is not known; the filter takes it as well where this raises."""
        if state is None:
            return self._settings.resting_action
        return self._robot.backup(state, self._model, self._settings)
