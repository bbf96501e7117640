"""The declaration of the pendulum."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, final

from safedpa.barrier_setting import BarrierSetting
from safedpa.robots.pendulum.system import PENDULUM
from safedpa.robots.shipped import ShippedRobot

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from safedpa.dynamics import AbstractBase, AbstractDynamics, PhysicsModel
    from safedpa.dynamics.simulator_export import SimulatorExport
    from safedpa.networks.frame import Frame
    from safedpa.operations import Operations, Scalar
    from safedpa.policy.perception import ObservationModel
    from safedpa.runtime.scene import AbstractScene
    from safedpa.safety.barriers.base import AbstractBarrier
    from safedpa.safety.settings import FilterSettings

_EDGE = 1.0
"""rad from the pendulum to the edges of a random corridor; any value would do."""


@final
class Pendulum(ShippedRobot):
    """An inverted pendulum with a motor in the wind, which must stay within a corridor of angles."""

    system = PENDULUM
    rate = 100.0
    model = "pendulum"
    measurement_deviation = (0.001, 0.02)
    calibrates_from_logs = True
    kinds = ("corridor",)
    barrier_settings = (
        BarrierSetting(
            "corridor_seconds", "s", 0.25, "time ahead at which the angle must be in the corridor", positive=True
        ),
    )
    options = ("task", "wind", "wind_direction", "payload", "dry_friction")
    nominal_range = ((-10.0, 10.0),)
    can_stop = False
    default_controller = "random"

    def bases(self) -> Mapping[str, Callable[..., AbstractBase]]:  # noqa: D102
        from safedpa.robots.pendulum.rigid_pendulum import RigidPendulum

        return {RigidPendulum.kind: RigidPendulum}

    def manoeuvres(  # noqa: D102
        self, t: NDArray[np.float64]
    ) -> dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]:
        from safedpa.robots.pendulum.manoeuvres import manoeuvres

        return manoeuvres(t)

    def simulator_export(self, model: PhysicsModel) -> SimulatorExport:  # noqa: D102
        from safedpa.robots.pendulum.simulator_export import simulator_export

        return simulator_export(model)

    def scene(self, model: AbstractDynamics, settings: FilterSettings) -> AbstractScene:  # noqa: D102
        from safedpa.robots.pendulum.scene import PendulumScene

        del model
        return PendulumScene(settings)

    def barriers_around(  # noqa: D102
        self,
        state: NDArray[np.float64],
        settings: FilterSettings,
        footprint: tuple[float, ...],
        draw: np.random.Generator,
    ) -> Sequence[AbstractBarrier]:
        from safedpa.safety.barriers.limits import CorridorBarrier

        del footprint, draw
        angle = float(state[0])
        return (CorridorBarrier(angle - _EDGE, angle + _EDGE, settings.barrier("corridor_seconds")),)

    def frame(self) -> Frame:  # noqa: D102
        from safedpa.networks.frame import Frame

        return Frame(("cos(angle)", "sin(angle)", "rate"), _features, None, 0)

    def perception(self) -> ObservationModel:  # noqa: D102
        from safedpa.robots.pendulum.perception import PERCEPTION

        return PERCEPTION


def _features(state: Sequence[Scalar], operations: Operations) -> list[Scalar]:
    """Returns the features of a state for the networks."""
    return [operations.cos(state[0]), operations.sin(state[0]), state[1]]


ROBOT = Pendulum()
