"""The declaration of the point robot."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, final

from safedpa.barrier_setting import BarrierSetting
from safedpa.robots.point.system import POINT
from safedpa.robots.shipped import ShippedRobot

if TYPE_CHECKING:
    from safedpa.dynamics import AbstractBase, AbstractDynamics, PhysicsModel
    from safedpa.networks.frame import Frame
    from safedpa.operations import Operations, Scalar
    from safedpa.policy.controller import Controller
    from safedpa.runtime.scene import AbstractScene
    from safedpa.safety.settings import FilterSettings


@final
class Point(ShippedRobot):
    """A small body on slides with a thruster along its heading and a turn servo, among hazards in a wind."""

    system = POINT
    rate = 50.0
    model = "point_wind"
    measurement_deviation = (0.0005, 0.0005, 0.005, 0.005, 0.005)
    smallest_motion = 0.1
    kinds = ("obstacle",)
    barrier_settings = (BarrierSetting("clearance", "m", 0.05, "distance kept from hazards beyond their radius"),)
    options = ("force", "wind_direction")
    nominal_range = ((-0.015, 0.015), (-3.0, 3.0))

    def bases(self) -> Mapping[str, Callable[..., AbstractBase]]:  # noqa: D102
        from safedpa.robots.point.point_mass import PointMass

        return {PointMass.kind: PointMass}

    def scene(self, model: AbstractDynamics, settings: FilterSettings) -> AbstractScene:  # noqa: D102
        from safedpa.robots.point.scene import PointScene

        return PointScene(model, settings)

    def controllers(self, model: PhysicsModel) -> Mapping[str, Callable[[], Controller]]:  # noqa: D102
        from safedpa.robots.point.goal_seeker import PointSeeker

        return {"goal_seeker": lambda: PointSeeker(model)}

    def learned(self, policy: Controller) -> Controller:  # noqa: D102
        from safedpa.policy.backing_off import BackOffController

        return BackOffController(policy)

    def frame(self) -> Frame:  # noqa: D102
        from safedpa.networks.frame import Frame

        names = ("cos(yaw)", "sin(yaw)", "speed along", "speed across")
        return Frame(names, _features, _rotation, 2, ((0, 1), (3, 4)))


def _rotation(state: Sequence[Scalar], operations: Operations) -> tuple[Scalar, Scalar]:
    return operations.cos(state[2]), operations.sin(state[2])


def _features(state: Sequence[Scalar], operations: Operations) -> list[Scalar]:
    """Returns the features of a state for the networks."""
    cosine, sine = _rotation(state, operations)
    x, y = state[3], state[4]
    return [cosine, sine, cosine * x + sine * y, cosine * y - sine * x]


ROBOT = Point()
