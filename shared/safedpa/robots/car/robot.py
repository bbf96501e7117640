"""What the car declares."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, final

from safedpa.robots.car.barrier_settings import BARRIER_SETTINGS
from safedpa.robots.car.system import CAR
from safedpa.robots.car.throttle_car import ThrottleCar
from safedpa.robots.shipped import ShippedRobot

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from safedpa.bus import StateMessage
    from safedpa.dynamics import AbstractBase, AbstractDynamics, PhysicsModel
    from safedpa.dynamics.elsewhere import Elsewhere
    from safedpa.networks.frame import Frame
    from safedpa.operations import Operations, Scalar
    from safedpa.policy.controller import Controller
    from safedpa.policy.perception import Perception
    from safedpa.ros.face import AbstractFace
    from safedpa.safety.barrier import AbstractBarrier
    from safedpa.safety.scene import AbstractScene
    from safedpa.safety.settings import FilterSettings

__all__ = ["ROBOT", "Car"]


@final
class Car(ShippedRobot):
    """A small four-wheeled robot with front steering and a speed servo, which may tow something."""

    system = CAR
    variants = (ThrottleCar(),)
    rate = 20.0
    model = "car"
    measurement_deviation = (0.01, 0.01, 0.01, 0.03)
    calibrates_from_logs = True
    theorem_margins = True
    kinds = ("obstacle", "field", "speed", "mover")
    barrier_settings = BARRIER_SETTINGS
    options = ("load", "change", "laser", "people")
    wish_range = ((-0.6, 2.0), (-0.34, 0.34))

    def bases(self) -> Mapping[str, Callable[..., AbstractBase]]:  # noqa: D102
        from safedpa.robots.car.kinematic_bicycle import KinematicBicycle

        return {KinematicBicycle.kind: KinematicBicycle}

    def scene(self, model: AbstractDynamics, settings: FilterSettings) -> AbstractScene:  # noqa: D102
        from safedpa.robots.car.car_scene import CarScene
        from safedpa.robots.car.quickness import quickness_of

        return CarScene(settings, quick=quickness_of(model, settings))

    def barriers_around(  # noqa: D102
        self,
        state: NDArray[np.float64],
        settings: FilterSettings,
        footprint: tuple[float, ...],
        draw: np.random.Generator,
    ) -> Sequence[AbstractBarrier]:
        from safedpa.robots.car.calibration_scene import barriers_around

        return barriers_around(state, settings, footprint, draw)

    def largest_gradients(  # noqa: D102
        self, settings: FilterSettings, footprint: Sequence[float], scale: NDArray[np.float64]
    ) -> Mapping[str, float]:
        from safedpa.robots.car.theory_gradient import largest_gradients

        return largest_gradients(settings, footprint, scale)

    def swept(self, state: StateMessage, settings: FilterSettings) -> tuple[float, float, float] | None:  # noqa: D102
        from safedpa.robots.car.barriers import swept_capsule

        return swept_capsule(state, settings)

    def elsewhere(self, model: PhysicsModel) -> Elsewhere:  # noqa: D102
        from safedpa.robots.car.elsewhere import elsewhere

        return elsewhere(model)

    def controllers(self, model: PhysicsModel) -> Mapping[str, Callable[[], Controller]]:  # noqa: D102
        from safedpa.robots.car.compensated_seeker import CompensatedGoalSeeker
        from safedpa.robots.car.goal_seeker import GoalSeekerSettings

        def planner() -> Controller:
            from safedpa.robots.car.planner import Planner

            return Planner(model)

        def way_seeker() -> Controller:
            from safedpa.robots.car.way_seeker import WaySeeker

            return WaySeeker(model)

        return {
            "goal_seeker": lambda: CompensatedGoalSeeker(model, GoalSeekerSettings()),
            "planner": planner,
            "way_seeker": way_seeker,
        }

    def ros_face(self, model: AbstractDynamics | None = None) -> AbstractFace:  # noqa: D102
        from safedpa.robots.car.ros_face import CarFace

        known = getattr(model, "settings", {}).get("base.wheelbase")
        return CarFace() if known is None else CarFace(float(known.value))

    def learned(self, policy: Controller) -> Controller:  # noqa: D102
        from safedpa.policy.backing_off import BackingOff

        return BackingOff(policy)

    def frame(self) -> Frame:  # noqa: D102
        from safedpa.networks.frame import Frame

        return Frame(("cos(yaw)", "sin(yaw)", "speed"), _features, _rotation, 2)

    def perception(self) -> Perception:  # noqa: D102
        from safedpa.robots.car.perception import PERCEPTION

        return PERCEPTION


def _features(state: Sequence[Scalar], operations: Operations) -> list[Scalar]:
    """What the networks see of a state."""
    return [operations.cos(state[2]), operations.sin(state[2]), state[3]]


def _rotation(state: Sequence[Scalar], operations: Operations) -> tuple[Scalar, Scalar]:
    return operations.cos(state[2]), operations.sin(state[2])


ROBOT = Car()
