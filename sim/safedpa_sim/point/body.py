"""Constants of the point robot's body and motors."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from typing import Final

SUBSTEPS: Final = 10
"""Physics steps per step of the task."""
CONTROL_SECONDS: Final = 0.02
"""s between two actions: ten steps of 2 ms."""


@dataclass(frozen=True)
class PointBody:
    """A ball with a box as nose, on two slides and a hinge through the ball's centre.

    Source: the published constants of the benchmark's point robot (Ray, Achiam, Amodei, Benchmarking Safe Exploration
    in Deep Reinforcement Learning, 2019, and its successor): shapes, density, dampings, motors, force limits.
    """

    ball_radius: float = 0.1
    """m."""
    nose_half_edge: float = 0.05
    """m; half an edge of the box."""
    nose_ahead: float = 0.1
    """m from the ball's centre to the box's."""
    density: float = 1.0
    """kg/m3 of ball and box."""
    slide_damping: float = 0.01
    """N s/m."""
    hinge_damping: float = 0.005
    """N m s/rad."""
    gear: float = 0.3
    """Thrust [N] per motor control, and torque per servo force."""
    force_limit: float = 0.05
    """Limit of both motors before the gear: the thrust saturates at a control of 0.05, the torque at 0.015 N m."""
    servo_gain: float = 1.0
    """Gain of the turning servo: torque = gear clip(gain (control - gear rate), +-force limit)."""

    @property
    def ball_mass(self) -> float:
        """kg."""
        return self.density * 4.0 / 3.0 * pi * self.ball_radius**3

    @property
    def nose_mass(self) -> float:
        """kg."""
        return self.density * (2.0 * self.nose_half_edge) ** 3

    @property
    def mass(self) -> float:
        """kg."""
        return self.ball_mass + self.nose_mass

    @property
    def centre_ahead(self) -> float:
        """m from the hinge to the centre of mass."""
        return self.nose_mass * self.nose_ahead / self.mass

    @property
    def hinge_inertia(self) -> float:
        """kg m2 about the hinge: 2/5 m r^2 of the ball, m (edge^2/6 + ahead^2) of the box."""
        edge = 2.0 * self.nose_half_edge
        return 0.4 * self.ball_mass * self.ball_radius**2 + self.nose_mass * (edge**2 / 6.0 + self.nose_ahead**2)

    @property
    def largest_thrust(self) -> float:
        """N."""
        return self.gear * self.force_limit

    @property
    def largest_turn(self) -> float:
        """rad/s at which the largest torque balances the hinge's damping."""
        return self.gear * self.force_limit / self.hinge_damping


POINT_BODY: Final = PointBody()
