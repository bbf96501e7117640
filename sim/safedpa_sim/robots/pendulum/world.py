"""The physics of the simulated pendulum: a mass on a light rod, a damped hinge, and a wind in the plane of motion."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, cos, hypot, radians, sin, tanh

from safedpa.errors import InputError

_SUBSTEP = 0.0005
"""s; longest step of the physics."""
_GRAVITY = 9.81
"""m/s2."""
_REST = 0.01
"""rad/s; below this rate dry friction fades to 0, so that the pendulum creeps instead of sticking."""

Point = tuple[float, float]


@dataclass(frozen=True)
class PendulumParameters:
    """Parameters from Shi et al., Meta-Adaptive Nonlinear Control (NeurIPS 2021); the torque limit is assumed."""

    length: float = 0.5
    """m."""
    mass: float = 1.0
    """kg."""
    friction: float = 1.0
    """N m s/rad of the hinge."""
    drag: float = 0.5
    """N s2/m2; air force over the square of the relative air speed."""
    payload: float = 0.0
    """kg added to the mass; unknown to every model."""
    dry_friction: float = 0.0
    """N m of Coulomb friction in the hinge; unknown to every model."""
    torque: float = 10.0
    """N m; largest torque of the motor (assumed)."""

    def __post_init__(self) -> None:
        for name in ("payload", "dry_friction"):
            if not 0.0 <= getattr(self, name) <= 10.0:
                raise InputError(f"{name}: got {getattr(self, name)}, wanted 0 to 10")


PENDULUM_PARAMETERS = PendulumParameters()


class PendulumWorld:
    """Simulates a point mass at (length sin(angle), length cos(angle)), x to the side and y up.

    The forces on the mass are projected onto the tangent of the arc,

        mass length d(rate)/dt = (weight + air) . tangent + (torque - friction rate - dry friction sign(rate)) / length,

    and integrated by the velocity Verlet method with the damping evaluated at the half step.
    """

    def __init__(
        self, angle: float, wind: Point = (0.0, 0.0), parameters: PendulumParameters = PENDULUM_PARAMETERS
    ) -> None:
        self.parameters = parameters
        self.wind = wind
        """Air speed along x and y, m/s."""
        self.angle, self.rate = angle, 0.0

    def put(self, angle: float) -> None:
        """Moves the pendulum to ``angle``, at rest."""
        self.angle, self.rate = angle, 0.0

    def advance(self, torque: float, seconds: float) -> tuple[float, float]:
        """Simulates ``seconds`` under a torque, in equal substeps; returns the lowest and highest angle."""
        substeps = ceil(seconds / _SUBSTEP - 1e-9)
        lowest = highest = self.angle
        for _ in range(substeps):
            self._substep(torque, seconds / substeps)
            lowest, highest = min(lowest, self.angle), max(highest, self.angle)
        return lowest, highest

    def _substep(self, torque: float, seconds: float) -> None:
        half = self.rate + 0.5 * seconds * self._acceleration(torque, self.rate)
        self.angle += seconds * half
        predicted = half + 0.5 * seconds * self._acceleration(torque, half)
        self.rate = half + 0.5 * seconds * self._acceleration(torque, predicted)

    def _acceleration(self, torque: float, rate: float) -> float:
        """Returns d(rate)/dt [rad/s2] at the current angle."""
        body = self.parameters
        along_x, along_y = cos(self.angle), -sin(self.angle)  # tangent of the arc for increasing angle
        speed = body.length * rate
        air_x, air_y = self.wind[0] - speed * along_x, self.wind[1] - speed * along_y  # relative to the mass
        pull = body.drag * hypot(air_x, air_y)
        mass = body.mass + body.payload
        force = pull * air_x * along_x + (pull * air_y - mass * _GRAVITY) * along_y
        friction = body.friction * rate + body.dry_friction * tanh(rate / _REST)
        return (force + (torque - friction) / body.length) / (mass * body.length)


def wind_towards(speed: float, degrees: float) -> Point:
    """Returns the components of a wind [m/s] towards a direction: 0 degrees towards positive angles, 90 up."""
    return speed * cos(radians(degrees)), speed * sin(radians(degrees))
