"""``AbstractRobot``, the base class of every robot declaration.

Generic code obtains everything specific to a robot through ``safedpa.systems.robots`` and knows no robot by name. Heavy
imports belong inside the methods that need them, so that listing robots is fast.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, ClassVar

from safedpa.errors import InputError
from safedpa.systems.robots import Robot

if TYPE_CHECKING:
    from pathlib import Path

    import numpy as np
    from numpy.typing import ArrayLike, NDArray

    from safedpa.bus import StateMessage
    from safedpa.drawing import Shape
    from safedpa.dynamics import AbstractBase, AbstractDynamics, PhysicsModel
    from safedpa.dynamics.simulator_export import SimulatorExport
    from safedpa.effects import AbstractEffect
    from safedpa.networks.frame import Frame
    from safedpa.policy.controller import Controller
    from safedpa.policy.perception import ObservationModel
    from safedpa.ros.face import AbstractFace
    from safedpa.runtime.scene import AbstractScene
    from safedpa.safety.barriers.base import AbstractBarrier
    from safedpa.safety.barriers.planar_body import PlanarBody
    from safedpa.safety.settings import FilterSettings
    from safedpa.stand_in import AbstractStandIn

__all__ = ["AbstractRobot"]


class AbstractRobot(Robot):
    """One kind of robot. Abstract members must be declared; the others have defaults for robots without the feature."""

    variants: ClassVar[tuple[AbstractRobot, ...]] = ()
    """The same robot with other actions, such as a throttle instead of a speed; selected by its model."""

    @property
    @abstractmethod
    def model(self) -> str | Path:
        """The default model: a file, or the name of a shipped one."""

    @abstractmethod
    def bases(self) -> Mapping[str, Callable[..., AbstractBase]]:
        """Returns factories of its base models by kind; classes take their ``choices`` by name."""

    @abstractmethod
    def settings(self) -> FilterSettings:
        """Returns the settings of its filter, with the bounds of its actions."""

    def effects(self) -> Iterable[AbstractEffect]:
        """Returns the effects that its base models may lack."""
        return ()

    def barriers(
        self, state: StateMessage, model: AbstractDynamics, latent: NDArray[np.float64] | None, settings: FilterSettings
    ) -> Sequence[AbstractBarrier]:
        """Returns the barriers at the measured state; at least one, such as a speed limit or a wall.

        Without barriers the filter takes the backup action. ``latent`` (latents,) is the newest estimate, None before
        the first. Raises InputError for an invalid state: the backup acts then, and the verdict has the reason.
        """
        raise InputError(f"robot '{self.name}': it declares no barriers; write its method 'barriers'")

    def barriers_around(
        self,
        state: NDArray[np.float64],
        settings: FilterSettings,
        footprint: tuple[float, ...],
        draw: np.random.Generator,
    ) -> Sequence[AbstractBarrier]:
        """Returns random barriers near a recorded ``state`` (states,), to calibrate margins from logs without a
        scene."""
        del state, settings, footprint, draw
        return ()

    def largest_gradients(
        self, settings: FilterSettings, footprint: Sequence[float], scale: NDArray[np.float64]
    ) -> Mapping[str, float]:
        """Returns the largest |d(h)/d(v)|_1 by kind of barrier, for increments v (states,) of ``scale`` in its own
        frame.

        Called only if ``theorem_margins`` is true.
        """
        raise NotImplementedError(f"robot '{self.name}': the largest gradients of its barriers are not known")

    def backup(self, state: NDArray[np.float64], model: AbstractDynamics, settings: FilterSettings) -> ArrayLike:
        """Returns the backup action (actions,) at ``state`` (states,), taken when no other action is known to be
        safe."""
        del state, model
        return settings.resting_action

    def scene(self, model: AbstractDynamics, settings: FilterSettings) -> AbstractScene | None:
        """Returns a scene that keeps barriers from tick to tick; None calls ``barriers`` in each tick.

        Raises InputError for a model or settings of another robot.
        """
        del model, settings
        return None

    def controllers(self, model: PhysicsModel) -> Mapping[str, Callable[[], Controller]]:
        """Returns factories of its own controllers by name; every robot also has ``random`` and ``learned``."""
        del model
        return {}

    def learned(self, policy: Controller) -> Controller:
        """Wraps a learned policy for this robot, for example with a recovery from being stuck."""
        return policy

    def frame(self) -> Frame | None:
        """Returns the frame in which its networks see the state; None without networks."""
        return None

    def perception(self) -> ObservationModel | None:
        """Returns the observation model of its learned policies; None without any."""
        return None

    def simulator_export(self, model: PhysicsModel) -> SimulatorExport | None:
        """Returns the export of the model to other simulators; None for the table of parameters only."""
        del model
        return None

    def ros_face(self, model: AbstractDynamics | None = None) -> AbstractFace | None:
        """Returns its ROS interface, with the dimensions of ``model`` if given; None for states as plain numbers."""
        del model
        return None

    def draw(self, state: StateMessage) -> Mapping[str, Shape]:
        """Returns the shapes of the robot by name; empty for curves only."""
        del state
        return {}

    def swept(self, state: StateMessage, settings: FilterSettings) -> tuple[float, float, float] | None:
        """Returns the capsule that its barriers keep free: rear and front end along the heading, and radius [m]."""
        del state, settings
        return None

    def planar_body(self, model: AbstractDynamics, settings: FilterSettings) -> PlanarBody | None:
        """Returns body, pose and braking of a planar robot, for barriers from sensors; None: it takes no sensors.

        The barriers of ``barriers`` without obstacles and field, such as speed limits, apply as well.
        """
        del model, settings
        return None

    def stand_in(self, seed: int, given: Mapping[str, float]) -> AbstractStandIn:
        """Returns a simulated robot; ``given`` has options of its world by name.

        Raises InputError for unknown options, and for a robot without a simulation.
        """
        raise InputError(
            f"robot '{self.name}': it has no simulated stand-in; run your own robot (docs/reference/bus.md)"
        )
