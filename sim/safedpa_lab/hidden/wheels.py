"""A differential drive with anything hidden in it, written again: 2 ms steps of Heun's method, a servo at each wheel.

wheel' = clip(gain (target - wheel), +-limit) / (1 + payload), speed their mean, turn rate their difference over the
track; nothing here comes from the models that are fitted to its logs.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa_lab.hidden.case import STEP
from safedpa_lab.hidden.lanes import Lane, Trajectories, gathered, per_lane

TRACK: Final = 0.233
"""m"""
SERVO: Final = 10.0
"""1/s"""
LIMIT: Final = 1.2
"""m/s2"""
_NEAR = 0.005
"""m/s; below it dry friction fades."""


def simulate_wheels(lanes: Sequence[Lane], period: float) -> Trajectories:
    """Every lane's run; the command of a row holds until the next row, and the motors start settled at the first."""
    return _Wheels(lanes, period).run()


class _Wheels:
    def __init__(self, lanes: Sequence[Lane], period: float) -> None:
        self.lanes, self.substeps = lanes, round(period / STEP)
        self.rows = len(lanes[0].commands.drive)
        start = np.array([lane.start for lane in lanes], dtype=np.float64)
        self.place = start[:, :3].copy()  # x, y, yaw
        self.wheels = start[:, 3, None] + 0.5 * TRACK * start[:, 4, None] * np.array([-1.0, 1.0])
        self.disturbance = per_lane(lanes)
        reported = [(lane.commands.drive, lane.commands.steer) for lane in lanes]
        self.actions = np.array([np.stack(pair, axis=1) for pair in reported])
        self.delay = np.rint(gathered(lanes, "actuator_delay", "seconds") / STEP).astype(np.int64)
        lag = np.maximum(gathered(lanes, "drive_lag", "time_constant"), 1e-6)
        self.follow = (1.0 - np.exp(-STEP / lag))[:, None]
        radius = gathered(lanes, "wheel_radius", "ratio", 1.0)
        self.scale = np.stack([radius, radius / gathered(lanes, "track_error", "ratio", 1.0)], axis=1)
        self.pull = gathered(lanes, "unequal_wheels", "pull")
        self.mass = 1.0 + gathered(lanes, "payload", "mass_ratio")[:, None]
        self.floor = gathered(lanes, "rolling_resistance", "deceleration")[:, None]
        self.slide = gathered(lanes, "wheel_slip", "compliance")

    def run(self) -> Trajectories:
        states = np.empty((len(self.lanes), self.rows, 5))
        lagged = self.scale * self.actions[:, 0]
        for row in range(self.rows):
            speed, turn = self._body(self.wheels)
            states[:, row] = np.column_stack([self.place, speed, turn])
            for step in range(self.substeps):
                lagged = self._substep(row * self.substeps + step, lagged)
        return Trajectories(states, self.actions)

    def _substep(self, now: int, lagged: FloatArray) -> FloatArray:
        """One step of all lanes; returns what the motors feel at its end."""
        row = np.maximum(now - self.delay, 0) // self.substeps
        sent = self.scale * self.actions[np.arange(len(self.lanes)), row]
        following = lagged + self.follow * (sent - lagged)
        felt = np.where(self.follow < 1.0, 0.5 * (lagged + following), following)
        turn = felt[:, 1] + self.pull * felt[:, 0]
        target = felt[:, :1] + 0.5 * TRACK * turn[:, None] * np.array([-1.0, 1.0])
        noise = self.disturbance[:, now // self.substeps]
        pushed = noise[:, :1] + 0.5 * TRACK * noise[:, 1:] * np.array([-1.0, 1.0])
        first = self._accelerations(self.wheels, target) + pushed
        ahead = self._accelerations(self.wheels + STEP * first, target) + pushed
        before = self._motion(self.place, self.wheels)
        wheels = self.wheels + 0.5 * STEP * (first + ahead)
        after = self._motion(self.place + STEP * before, wheels)
        self.place, self.wheels = self.place + 0.5 * STEP * (before + after), wheels
        return np.asarray(following)

    def _accelerations(self, wheels: FloatArray, target: FloatArray) -> FloatArray:
        driven = np.clip(SERVO * (target - wheels), -LIMIT, LIMIT) / self.mass
        along = np.tanh(wheels.mean(axis=1, keepdims=True) / _NEAR)
        return np.asarray(driven - self.floor * along)

    def _motion(self, place: FloatArray, wheels: FloatArray) -> FloatArray:
        speed, turn = self._body(wheels)
        cosine, sine = np.cos(place[:, 2]), np.sin(place[:, 2])
        aside = self.slide * speed * turn
        return np.stack([speed * cosine + aside * sine, speed * sine - aside * cosine, turn], axis=1)

    @staticmethod
    def _body(wheels: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Speed and turn rate."""
        return wheels.mean(axis=1), (wheels[:, 1] - wheels[:, 0]) / TRACK
