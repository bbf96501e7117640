"""The declaration of the car."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, final

from safedpa.robots.car.barriers.settings import BARRIER_SETTINGS
from safedpa.robots.car.robot_throttle import ThrottleCar
from safedpa.robots.car.system import CAR
from safedpa.robots.shipped import ShippedRobot

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from safedpa.bus import StateMessage
    from safedpa.dynamics import AbstractBase, AbstractDynamics, PhysicsModel
    from safedpa.dynamics.simulator_export import SimulatorExport
    from safedpa.networks.frame import Frame
    from safedpa.operations import Operations, Scalar
    from safedpa.policy.controller import Controller
    from safedpa.policy.perception import ObservationModel
    from safedpa.ros.face import AbstractFace
    from safedpa.runtime.scene import AbstractScene
    from safedpa.safety.barriers.base import AbstractBarrier
    from safedpa.safety.settings import FilterSettings


@final
class Car(ShippedRobot):
    """A small four-wheeled robot with front steering and a speed servo, which may tow a load."""

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
    nominal_range = ((-0.6, 2.0), (-0.34, 0.34))

    def bases(self) -> Mapping[str, Callable[..., AbstractBase]]:  # noqa: D102
        from safedpa.robots.car.dynamics.kinematic_bicycle import KinematicBicycle

        return {KinematicBicycle.kind: KinematicBicycle}

    def scene(self, model: AbstractDynamics, settings: FilterSettings) -> AbstractScene:  # noqa: D102
        from safedpa.robots.car.dynamics.limits import performance_limits
        from safedpa.robots.car.scenes.perceived import CarScene

        return CarScene(settings, quick=performance_limits(model, settings))

    def barriers_around(  # noqa: D102
        self,
        state: NDArray[np.float64],
        settings: FilterSettings,
        footprint: tuple[float, ...],
        draw: np.random.Generator,
    ) -> Sequence[AbstractBarrier]:
        from safedpa.robots.car.scenes.calibration import barriers_around

        return barriers_around(state, settings, footprint, draw)

    def largest_gradients(  # noqa: D102
        self, settings: FilterSettings, footprint: Sequence[float], scale: NDArray[np.float64]
    ) -> Mapping[str, float]:
        from safedpa.robots.car.barriers.gradient_bounds import largest_gradients

        return largest_gradients(settings, footprint, scale)

    def swept(self, state: StateMessage, settings: FilterSettings) -> tuple[float, float, float] | None:  # noqa: D102
        from safedpa.robots.car.barriers.obstacles import swept_capsule

        return swept_capsule(state, settings)

    def simulator_export(self, model: PhysicsModel) -> SimulatorExport:  # noqa: D102
        from safedpa.robots.car.adapters.gazebo import simulator_export

        return simulator_export(model)

    def controllers(self, model: PhysicsModel) -> Mapping[str, Callable[[], Controller]]:  # noqa: D102
        from safedpa.robots.car.controllers.goal_seeker import GoalSeekerSettings, InverseDynamicsGoalSeeker

        def planner() -> Controller:
            from safedpa.robots.car.controllers.mppi import Planner

            return Planner(model)

        def way_seeker() -> Controller:
            from safedpa.robots.car.controllers.route_follower import RouteFollower

            return RouteFollower(model)

        return {
            "goal_seeker": lambda: InverseDynamicsGoalSeeker(model, GoalSeekerSettings()),
            "planner": planner,
            "way_seeker": way_seeker,
        }

    def ros_face(self, model: AbstractDynamics | None = None) -> AbstractFace:  # noqa: D102
        from safedpa.robots.car.adapters.ros import CarFace

        known = getattr(model, "settings", {}).get("base.wheelbase")
        return CarFace() if known is None else CarFace(float(known.value))

    def learned(self, policy: Controller) -> Controller:  # noqa: D102
        from safedpa.policy.backing_off import BackOffController

        return BackOffController(policy)

    def frame(self) -> Frame:  # noqa: D102
        from safedpa.networks.frame import Frame

        return Frame(("cos(yaw)", "sin(yaw)", "speed"), _features, _rotation, 2)

    def perception(self) -> ObservationModel:  # noqa: D102
        from safedpa.robots.car.perception import PERCEPTION

        return PERCEPTION


def _features(state: Sequence[Scalar], operations: Operations) -> list[Scalar]:
    """Returns the features of a state for the networks."""
    return [operations.cos(state[2]), operations.sin(state[2]), state[3]]


def _rotation(state: Sequence[Scalar], operations: Operations) -> tuple[Scalar, Scalar]:
    return operations.cos(state[2]), operations.sin(state[2])


ROBOT = Car()
