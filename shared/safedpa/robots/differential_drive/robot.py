"""The declaration of the differential drive."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import cos, sin
from typing import TYPE_CHECKING, Final, final

from safedpa.barrier_setting import BarrierSetting
from safedpa.robots.differential_drive.system import DIFFERENTIAL_DRIVE, TRACK
from safedpa.robots.shipped import ShippedRobot

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from safedpa.bus import StateMessage
    from safedpa.drawing import Shape
    from safedpa.dynamics import AbstractBase, AbstractDynamics, PhysicsModel
    from safedpa.policy.controller import Controller
    from safedpa.ros.face import AbstractFace
    from safedpa.safety.barriers.base import AbstractBarrier
    from safedpa.safety.barriers.planar_body import PlanarBody
    from safedpa.safety.settings import FilterSettings
    from safedpa.stand_in import AbstractStandIn

_STAND_IN = "safedpa_sim.differential_drive.stand_in"
_RADIUS = 0.17
"""m; radius of the body, when a state has no footprint."""
_WHEEL = 0.05
"""m; half of the drawn length of a wheel."""
_BARRIER_SETTINGS: Final = (
    BarrierSetting("braking_deceleration", "m/s2", 0.7, "guaranteed braking of a wheel with every load", positive=True),
    BarrierSetting("braking_gain", "1/s", 5.0, "least gain of a wheel's servo, with every load", positive=True),
    BarrierSetting("clearance", "m", 0.03, "distance kept from obstacles and walls beyond the radius"),
    BarrierSetting(
        "creeping", "s", 0.0, "h in m per m/s below 0.1 m/s towards hidden areas, which lets it creep; 0: it stops"
    ),
    BarrierSetting("speed_low", "m/s", -0.3, "slightly beyond the actuator limit", signed=True),
    BarrierSetting("speed_high", "m/s", 0.65, "slightly beyond the actuator limit", signed=True, above="speed_low"),
)
"""The defaults fit the simulated robot."""


@final
class DifferentialDrive(ShippedRobot):
    """A robot with two driven wheels on one axle, commanded by speed and turn rate."""

    system = DIFFERENTIAL_DRIVE
    rate = 20.0
    model = "differential_drive"
    measurement_deviation = (0.003, 0.003, 0.005, 0.01, 0.02)
    kinds = ("obstacle", "field", "speed", "mover")
    barrier_settings = _BARRIER_SETTINGS
    nominal_range = ((-0.2, 0.5), (-1.9, 1.9))

    def bases(self) -> Mapping[str, Callable[..., AbstractBase]]:  # noqa: D102
        from safedpa.robots.differential_drive.servo_wheels import ServoWheels

        return {ServoWheels.kind: ServoWheels}

    def barriers(  # noqa: D102
        self, state: StateMessage, model: AbstractDynamics, latent: NDArray[np.float64] | None, settings: FilterSettings
    ) -> Sequence[AbstractBarrier]:
        from safedpa.errors import InputError
        from safedpa.robots.differential_drive.barriers import Shape as Measures
        from safedpa.robots.differential_drive.barriers import wheeled_barriers

        del latent
        if state.corridor:
            raise InputError("got a corridor, wanted obstacles and a field")
        if len(state.footprint) not in (0, 3):
            raise InputError(f"footprint: got {len(state.footprint)} numbers, wanted rear, front and radius in m")
        known = getattr(model, "settings", {}).get("base.track")
        track = TRACK if known is None else float(known.value)
        rear, front, radius = state.footprint or (0.0, 0.0, _RADIUS)
        return wheeled_barriers(settings, Measures(rear, front, radius, track), state.obstacles, state.field)

    def planar_body(self, model: AbstractDynamics, settings: FilterSettings) -> PlanarBody:  # noqa: D102
        from safedpa.safety.barriers.planar_body import PlanarBody

        known = getattr(model, "settings", {}).get("base.track")
        return PlanarBody(
            settings.barrier("braking_deceleration"),
            settings.barrier("braking_gain"),
            max(abs(settings.barrier("speed_low")), abs(settings.barrier("speed_high"))),
            turn_rate="turn_rate",
            track=TRACK if known is None else float(known.value),
            clearance=settings.barrier("clearance"),
            creeping=settings.barrier("creeping"),
        )

    def controllers(self, model: PhysicsModel) -> Mapping[str, Callable[[], Controller]]:  # noqa: D102
        from safedpa.robots.differential_drive.goal_seeker import WheeledSeeker

        del model
        return {"goal_seeker": WheeledSeeker, "straight": lambda: WheeledSeeker(looks=False)}

    def ros_face(self, model: AbstractDynamics | None = None) -> AbstractFace:  # noqa: D102
        from safedpa.robots.differential_drive.ros_face import DifferentialDriveFace

        del model
        return DifferentialDriveFace()

    def draw(self, state: StateMessage) -> Mapping[str, Shape]:  # noqa: D102
        return _drawn(state, state.footprint[2] if len(state.footprint) == 3 else _RADIUS)

    def stand_in(self, seed: int, given: Mapping[str, float]) -> AbstractStandIn:  # noqa: D102
        from importlib import import_module

        from safedpa.extras import need

        need("sim", what="the simulated robot")
        found: AbstractStandIn = import_module(_STAND_IN).WheeledStandIn(seed, **given)
        return found


def _drawn(state: StateMessage, radius: float) -> Mapping[str, Shape]:
    """Returns a disc with two wheels and a line for the heading."""
    from safedpa.drawing import Lines, Rings

    x, y, yaw = state.values[:3]
    ahead, aside = (cos(yaw), sin(yaw)), (-sin(yaw), cos(yaw))

    def position(forward: float, left: float) -> tuple[float, float]:
        return x + forward * ahead[0] + left * aside[0], y + forward * ahead[1] + left * aside[1]

    wheels = [(position(-_WHEEL, side * TRACK / 2), position(_WHEEL, side * TRACK / 2)) for side in (-1.0, 1.0)]
    return {
        "body": Rings(((x, y),), (radius,), 0xE6EDF3FF, 0.012),
        "wheels": Lines((*wheels, ((x, y), position(radius, 0.0))), (0x8B949EFF, 0x8B949EFF, 0xE3B341FF), 0.03),
    }


ROBOT = DifferentialDrive()
