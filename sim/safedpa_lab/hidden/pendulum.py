"""A pendulum with anything hidden in it, written again: 2 ms steps of Heun's method, friction with true standstill.

mass length^2 rate' = torque + mass gravity length sin(angle), angle 0 upright; nothing here comes from the models that
are fitted to its logs.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa_lab.hidden.case import STEP
from safedpa_lab.hidden.lanes import Lane, Trajectories, gathered, per_lane

MASS: Final = 1.0
"""kg"""
LENGTH: Final = 0.5
"""m"""
GRAVITY: Final = 9.81
"""m/s2"""
_DAMPING = 0.4
"""N m s/rad of the driver, who takes out the energy that the torque brings in."""


def simulate_pendulums(lanes: Sequence[Lane], period: float) -> Trajectories:
    """Every lane's run; the torque of a row holds until the next row, and the motor starts settled at the first."""
    return _Pendulums(lanes, period).run()


class _Pendulums:
    def __init__(self, lanes: Sequence[Lane], period: float) -> None:
        self.lanes, self.substeps = lanes, round(period / STEP)
        self.rows = len(lanes[0].commands.drive)
        self.angle, self.rate = np.array([lane.start for lane in lanes], dtype=np.float64).T.copy()
        self.disturbance = per_lane(lanes)
        self.torques = np.zeros((len(lanes), self.rows))
        self.each = np.arange(len(lanes))
        self.delay = np.rint(gathered(lanes, "torque_delay", "seconds") / STEP).astype(np.int64)
        lag = np.maximum(gathered(lanes, "torque_lag", "time_constant"), 1e-6)
        self.follow = np.asarray(1.0 - np.exp(-STEP / lag))
        self.gain = gathered(lanes, "torque_gain", "gain", 1.0)
        self.gain_per_rate = gathered(lanes, "torque_gain", "gain_per_abs_rate")
        self.offset = gathered(lanes, "torque_offset", "offset")
        self.play = 0.5 * gathered(lanes, "backlash", "width")
        self._read_loads()

    def _read_loads(self) -> None:
        lanes = self.lanes
        self.mass = MASS + gathered(lanes, "tip_mass", "mass")
        self.viscous = gathered(lanes, "viscous_friction", "coefficient")
        self.coulomb = gathered(lanes, "coulomb_friction", "torque")
        self.stribeck = gathered(lanes, "stribeck_friction", "torque")
        self.fading = gathered(lanes, "stribeck_friction", "fading_rate", 1.0)
        self.wind = gathered(lanes, "wind", "speed")
        self.air = gathered(lanes, "wind", "drag")
        self.blows = bool(self.air.any())
        self.stiffness = gathered(lanes, "spring", "stiffness")
        self.rest = gathered(lanes, "spring", "rest_angle")
        self.shown = gathered(lanes, "angle_offset", "offset")

    def run(self) -> Trajectories:
        states = np.empty((len(self.lanes), self.rows, 2))
        for row in range(self.rows):
            wanted = np.array([lane.commands.drive[row] for lane in self.lanes])
            self.torques[:, row] = wanted - _DAMPING * self.rate
            if row == 0:
                self.lagged = self._scale() * self.torques[:, 0]
                self.geared = self.lagged + self.offset
            states[:, row] = np.stack([self.angle + self.shown, self.rate], axis=1)
            for step in range(self.substeps):
                self._substep(row, step)
        return Trajectories(states, self.torques[:, :, None])

    def _substep(self, row: int, step: int) -> None:
        torque = self._felt(row * self.substeps + step)
        noise = self.disturbance[:, row, 0]
        first = self._acceleration(self.angle, self.rate, torque) + noise
        ahead = self._acceleration(self.angle + STEP * self.rate, self.rate + STEP * first, torque) + noise
        free = self.rate + 0.5 * STEP * (first + ahead)
        dry = self.coulomb + self.stribeck * np.exp(-((free / self.fading) ** 2))
        slowed = np.sign(free) * np.maximum(np.abs(free) - STEP * dry / (self.mass * LENGTH**2), 0.0)
        self.angle = self.angle + 0.5 * STEP * (self.rate + slowed)
        self.rate = slowed

    def _acceleration(self, angle: FloatArray, rate: FloatArray, torque: FloatArray) -> FloatArray:
        sine = np.sin(angle)
        pushed = torque + self.mass * GRAVITY * LENGTH * sine
        if self.blows:  # else nothing is added, to the last bit
            cosine = np.cos(angle)
            tip_x, tip_y = LENGTH * rate * cosine, LENGTH * rate * sine
            against_x, against_y = self.wind - tip_x, -tip_y
            size = np.hypot(against_x, against_y)
            pushed = pushed + LENGTH * self.air * size * (cosine * against_x + sine * against_y)
        spring = self.stiffness * (angle - self.rest)
        return np.asarray((pushed - spring - self.viscous * rate) / (self.mass * LENGTH**2))

    def _felt(self, now: int) -> FloatArray:
        """The torque at the pivot during step ``now``: gain, delay, lag, offset, play."""
        row = np.maximum(now - self.delay, 0) // self.substeps
        sent = self._scale() * self.torques[self.each, row]
        before = self.lagged
        self.lagged = before + self.follow * (sent - before)
        at_motor = np.where(self.follow < 1.0, 0.5 * (before + self.lagged), self.lagged) + self.offset
        self.geared = np.minimum(np.maximum(self.geared, at_motor - self.play), at_motor + self.play)
        return self.geared

    def _scale(self) -> FloatArray:
        """What the motor makes of a torque; never of the other sign."""
        return np.asarray(np.maximum(self.gain + self.gain_per_rate * np.abs(self.rate), 0.0))
