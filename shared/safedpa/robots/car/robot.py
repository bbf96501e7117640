"""The declarations of the car: with a speed servo, and commanded by throttle instead of speed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Final, final

from safedpa.barrier_setting import BarrierSetting
from safedpa.robots.car.system import CAR, CAR_THROTTLE
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

_BARRIER_SETTINGS: Final = (
    BarrierSetting("braking_deceleration", "m/s2", 2.0, "guaranteed braking with every load", positive=True),
    BarrierSetting("braking_gain", "1/s", 2.5, "least gain of the speed servo, with every load", positive=True),
    BarrierSetting("clearance", "m", 0.05, "distance kept from obstacles and walls beyond the radius"),
    BarrierSetting(
        "own_radius", "m", 0.0, "radius of the car's own body, for movers while it tows; 0: that of the footprint"
    ),
    BarrierSetting(
        "creeping", "s", 0.0, "h in m per m/s below 0.1 m/s towards hidden areas, which lets the car creep; 0: it stops"
    ),
    BarrierSetting(
        "speed_low", "m/s", -0.8, "slightly beyond the actuator limit, so that full speed is permitted", signed=True
    ),
    BarrierSetting("speed_high", "m/s", 2.2, "slightly beyond the actuator limit", signed=True, above="speed_low"),
)
"""The defaults fit the simulated car."""


class _AnyCar(ShippedRobot):
    rate = 20.0
    measurement_deviation = (0.01, 0.01, 0.01, 0.03)
    calibrates_from_logs = True
    kinds = ("obstacle", "field", "speed", "mover")
    barrier_settings = _BARRIER_SETTINGS

    def bases(self) -> Mapping[str, Callable[..., AbstractBase]]:
        from safedpa.robots.car.dynamics.kinematic_bicycle import KinematicBicycle

        return {KinematicBicycle.kind: KinematicBicycle}

    def manoeuvres(self, t: NDArray[np.float64]) -> dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]:
        from safedpa.robots.car.manoeuvres import manoeuvres

        return manoeuvres(t, throttle=self.system is CAR_THROTTLE)

    def barriers_around(
        self,
        state: NDArray[np.float64],
        settings: FilterSettings,
        footprint: tuple[float, ...],
        draw: np.random.Generator,
    ) -> Sequence[AbstractBarrier]:
        from safedpa.robots.car.barriers.obstacles import barriers_around

        return barriers_around(state, settings, footprint, draw)


@final
class ThrottleCar(_AnyCar):
    """The small car of the DART logs, with a throttle from -1 to 1 (0 lets it roll); it cannot tow a load."""

    system = CAR_THROTTLE
    model = "dart_car"
    options = ("change", "laser", "people")
    nominal_range = ((-1.0, 1.0), (-0.34, 0.34))
    settings_name = "car_throttle"
    # One period of full throttle changes the speed by up to 0.4 m/s: a late command looks like a motor without force.
    command_timing = 0.15
    stand_in_options = ("--drive=throttle",)

    def scene(self, model: AbstractDynamics, settings: FilterSettings) -> AbstractScene:  # noqa: D102
        from safedpa.robots.car.barriers.obstacles import braking_of
        from safedpa.robots.car.dynamics.limits import performance_limits
        from safedpa.robots.car.dynamics.throttle import BrakingByThrottle
        from safedpa.robots.car.scenes.perceived import CarScene

        bounds = (settings.action_low[0], settings.action_high[0])
        return CarScene(
            settings, BrakingByThrottle(model, braking_of(settings), bounds), performance_limits(model, settings)
        )

    def controllers(self, model: PhysicsModel) -> Mapping[str, Callable[[], Controller]]:  # noqa: D102
        from safedpa.robots.car.controllers.goal_seeker import GoalSeekerSettings, ThrottledGoalSeeker

        wheelbase = model.settings["base.wheelbase"].value
        settings = GoalSeekerSettings(wheelbase=wheelbase, cruise_speed=1.4)
        return {"goal_seeker": lambda: ThrottledGoalSeeker(model, settings)}

    def ros_face(self, model: AbstractDynamics | None = None) -> AbstractFace:  # noqa: D102
        from safedpa.robots.car.adapters.ros import ThrottleCarFace

        known = getattr(model, "settings", {})
        numbers = (known.get(f"base.{name}") for name in ("drive_gain", "wheelbase"))
        drive_gain, wheelbase = (None if one is None else float(one.value) for one in numbers)
        return ThrottleCarFace(drive_gain or 4.48, wheelbase or 0.32)


@final
class Car(_AnyCar):
    """A small four-wheeled robot with front steering and a speed servo, which may tow a load."""

    system = CAR
    variants = (ThrottleCar(),)
    model = "car"
    theorem_margins = True
    options = ("load", "change", "laser", "people")
    nominal_range = ((-0.6, 2.0), (-0.34, 0.34))

    def scene(self, model: AbstractDynamics, settings: FilterSettings) -> AbstractScene:  # noqa: D102
        from safedpa.robots.car.dynamics.limits import performance_limits
        from safedpa.robots.car.scenes.perceived import CarScene

        return CarScene(settings, quick=performance_limits(model, settings))

    def largest_gradients(  # noqa: D102
        self, settings: FilterSettings, footprint: Sequence[float], scale: NDArray[np.float64]
    ) -> Mapping[str, float]:
        from safedpa.robots.car.barriers.obstacles import largest_gradients

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
