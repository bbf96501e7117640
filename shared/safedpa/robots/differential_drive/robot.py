"""What the differential drive declares."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, final

from safedpa.robots.differential_drive.barrier_settings import BARRIER_SETTINGS
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
    from safedpa.safety.barrier import AbstractBarrier
    from safedpa.safety.settings import FilterSettings
    from safedpa.stand_in import AbstractStandIn

__all__ = ["ROBOT", "DifferentialDrive"]

_STAND_IN = "safedpa_sim.differential_drive.stand_in"
_RADIUS = 0.17
"""m, where nobody tells the footprint."""


@final
class DifferentialDrive(ShippedRobot):
    """A robot on two driven wheels, commanded by speed and turn rate as most are."""

    system = DIFFERENTIAL_DRIVE
    rate = 20.0
    model = "differential_drive"
    measurement_deviation = (0.003, 0.003, 0.005, 0.01, 0.02)
    kinds = ("obstacle", "field", "speed")
    barrier_settings = BARRIER_SETTINGS
    wish_range = ((-0.2, 0.5), (-1.9, 1.9))

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

    def controllers(self, model: PhysicsModel) -> Mapping[str, Callable[[], Controller]]:  # noqa: D102
        from safedpa.robots.differential_drive.seeker import WheeledSeeker

        del model
        return {"goal_seeker": WheeledSeeker, "straight": lambda: WheeledSeeker(looks=False)}

    def ros_face(self, model: AbstractDynamics | None = None) -> AbstractFace:  # noqa: D102
        from safedpa.robots.differential_drive.ros_face import DifferentialDriveFace

        del model
        return DifferentialDriveFace()

    def draw(self, state: StateMessage) -> Mapping[str, Shape]:  # noqa: D102
        from safedpa.robots.differential_drive.drawn import drawn

        return drawn(state, state.footprint[2] if len(state.footprint) == 3 else _RADIUS)

    def stand_in(self, seed: int, given: Mapping[str, float]) -> AbstractStandIn:  # noqa: D102
        from importlib import import_module

        from safedpa.extras import need

        need("sim", what="the simulated robot")
        found: AbstractStandIn = import_module(_STAND_IN).WheeledStandIn(seed, **given)
        return found


ROBOT = DifferentialDrive()
