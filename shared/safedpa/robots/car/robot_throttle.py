"""The declaration of the car that is commanded by throttle instead of speed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, final

from safedpa.robots.car.barriers.settings import BARRIER_SETTINGS
from safedpa.robots.car.system import CAR_THROTTLE
from safedpa.robots.shipped import ShippedRobot

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from safedpa.dynamics import AbstractBase, AbstractDynamics, PhysicsModel
    from safedpa.policy.controller import Controller
    from safedpa.ros.face import AbstractFace
    from safedpa.runtime.scene import AbstractScene
    from safedpa.safety.barriers.base import AbstractBarrier
    from safedpa.safety.settings import FilterSettings


@final
class ThrottleCar(ShippedRobot):
    """The small car of the DART logs, with a throttle from -1 to 1 (0 lets it roll); it cannot tow a load."""

    system = CAR_THROTTLE
    rate = 20.0
    model = "dart_car"
    measurement_deviation = (0.01, 0.01, 0.01, 0.03)
    calibrates_from_logs = True
    kinds = ("obstacle", "field", "speed", "mover")
    barrier_settings = BARRIER_SETTINGS
    options = ("change", "laser", "people")
    nominal_range = ((-1.0, 1.0), (-0.34, 0.34))
    settings_name = "car_throttle"
    stand_in_options = ("--drive=throttle",)

    def bases(self) -> Mapping[str, Callable[..., AbstractBase]]:  # noqa: D102
        from safedpa.robots.car.dynamics.kinematic_bicycle import KinematicBicycle

        return {KinematicBicycle.kind: KinematicBicycle}

    def scene(self, model: AbstractDynamics, settings: FilterSettings) -> AbstractScene:  # noqa: D102
        from safedpa.robots.car.barriers.obstacles import braking_of
        from safedpa.robots.car.dynamics.limits import performance_limits
        from safedpa.robots.car.dynamics.throttle import BrakingByThrottle
        from safedpa.robots.car.scenes.perceived import CarScene

        bounds = (settings.action_low[0], settings.action_high[0])
        return CarScene(
            settings, BrakingByThrottle(model, braking_of(settings), bounds), performance_limits(model, settings)
        )

    def barriers_around(  # noqa: D102
        self,
        state: NDArray[np.float64],
        settings: FilterSettings,
        footprint: tuple[float, ...],
        draw: np.random.Generator,
    ) -> Sequence[AbstractBarrier]:
        from safedpa.robots.car.scenes.calibration import barriers_around

        return barriers_around(state, settings, footprint, draw)

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
