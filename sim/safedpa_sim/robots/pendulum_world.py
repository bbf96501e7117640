"""The world of the simulated pendulum: a mass on a light rod, a damped hinge, a wind in the plane of its motion."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, cos, hypot, radians, sin, tanh

from safedpa.errors import InputError

__all__ = ["PENDULUM_PARAMETERS", "PendulumParameters", "PendulumWorld", "wind_towards"]

_SUBSTEP = 0.0005
"""s; longest step of the physics."""
_GRAVITY = 9.81
"""m/s2."""
_REST = 0.01
"""rad/s; below it dry friction fades, so that a pendulum creeps where it would stick."""

Point = tuple[float, float]


@dataclass(frozen=True)
class PendulumParameters:
    """Numbers of Shi et al., Meta-Adaptive Nonlinear Control (NeurIPS 2021), and the torque assumed here."""

    length: float = 0.5
    """m."""
    mass: float = 1.0
    """kg."""
    friction: float = 1.0
    """N m s/rad of the hinge."""
    drag: float = 0.5
    """N s2/m2; force of the air over the square of its speed past the mass."""
    payload: float = 0.0
    """kg hung on the mass; no model is told."""
    dry_friction: float = 0.0
    """N m of the hinge against any motion; no model is told."""
    torque: float = 10.0
    """N m; the motor's largest; an assumption."""

    def __post_init__(self) -> None:
        for name in ("payload", "dry_friction"):
            if not 0.0 <= getattr(self, name) <= 10.0:
                raise InputError(f"{name}: got {getattr(self, name)}, wanted 0 to 10")


PENDULUM_PARAMETERS = PendulumParameters()


class PendulumWorld:
    """Steps the physics of a point mass at (length sin(angle), length cos(angle)), x to the side and y up.

    The forces on the mass are summed in the plane and taken along the arc,
    mass length d(rate)/dt = (weight + air) . tangent + (torque - friction rate - dry friction sign(rate)) / length,
    and integrated by the velocity form of Verlet's method with the damping evaluated at the half step.
    """

    def __init__(
        self,
        angle: float,
        wind: Point = (0.0, 0.0),
        parameters: PendulumParameters = PENDULUM_PARAMETERS,
    ) -> None:
        self.parameters = parameters
        self.wind = wind
        """Speed of the air along x and y, m/s."""
        self.angle, self.rate = angle, 0.0

    def put(self, angle: float) -> None:
        """Puts it somewhere else, at rest."""
        self.angle, self.rate = angle, 0.0

    def advance(self, torque: float, seconds: float) -> tuple[float, float]:
        """Holds a torque for ``seconds``, in equal substeps; the lowest and highest angle on the way."""
        substeps = ceil(seconds / _SUBSTEP - 1e-9)
        lowest = highest = self.angle
        for _ in range(substeps):
            self._substep(torque, seconds / substeps)
            lowest, highest = min(lowest, self.angle), max(highest, self.angle)
        return lowest, highest

    def _substep(self, torque: float, seconds: float) -> None:
        half = self.rate + 0.5 * seconds * self._acceleration(torque, self.rate)
        self.angle += seconds * half
        arrived = half + 0.5 * seconds * self._acceleration(torque, half)
        self.rate = half + 0.5 * seconds * self._acceleration(torque, arrived)

    def _acceleration(self, torque: float, rate: float) -> float:
        """d(rate)/dt [rad/s2] at the angle now."""
        body = self.parameters
        along_x, along_y = cos(self.angle), -sin(self.angle)  # the arc's direction as the angle grows
        speed = body.length * rate
        past_x, past_y = self.wind[0] - speed * along_x, self.wind[1] - speed * along_y
        pull = body.drag * hypot(past_x, past_y)
        mass = body.mass + body.payload
        force = pull * past_x * along_x + (pull * past_y - mass * _GRAVITY) * along_y
        rubbed = body.friction * rate + body.dry_friction * tanh(rate / _REST)
        return (force + (torque - rubbed) / body.length) / (mass * body.length)


def wind_towards(speed: float, degrees: float) -> Point:
    """A wind of ``speed`` [m/s] that blows towards a direction: 0 to where positive angles lean, 90 up."""
    return speed * cos(radians(degrees)), speed * sin(radians(degrees))
