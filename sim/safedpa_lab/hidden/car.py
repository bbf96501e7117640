"""A car with anything hidden in it, written again: 2 ms steps of Heun's method, Coulomb friction with true standstill.

Nothing here comes from the models that are fitted to its logs. Every lane has every effect; what is not hidden has
its neutral value.

Source of the method: Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, section II.1 (Heun, order 2).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray
from safedpa_lab.hidden.case import LARGEST_STEER, STEP
from safedpa_lab.hidden.lanes import Lane, Trajectories, gathered, per_lane

WHEELBASE: Final = 0.32
"""m"""
ACCELERATION_LIMIT: Final = 6.0
"""m/s2 of the speed servo."""
_HOME = 4.0
"""m from the origin at which the driver turns back."""
_LATERAL = 6.0
"""m/s2; the driver steers no more than that at the speed he drives."""
_ENDS = (("above", -np.inf), ("below", np.inf))
"""Borders of a region, and where there is none."""
_FARTHEST_STEER = 10.0
"""rad; stops that no steer reaches."""


def simulate_cars(lanes: Sequence[Lane], period: float) -> Trajectories:
    """Every lane's run; the action of a row holds until the next row, and actuators start settled at the first."""
    return _Cars(lanes, period).run()


class _Cars:
    """State and parameters of all lanes, arrays (lanes,)."""

    def __init__(self, lanes: Sequence[Lane], period: float) -> None:
        self.lanes, self.substeps = lanes, round(period / STEP)
        self.rows = len(lanes[0].commands.drive)
        self.x, self.y, self.yaw, self.speed = np.array([lane.start for lane in lanes], dtype=np.float64).T.copy()
        self.throttle = np.array([lane.throttle for lane in lanes])
        self.gain = np.array([lane.gain for lane in lanes])
        self.disturbance = per_lane(lanes)
        self.actions = np.zeros((len(lanes), self.rows, 2))
        self.each = np.arange(len(lanes))
        self._read_command_effects()
        self._read_forces()
        self._read_laws()

    def _read_command_effects(self) -> None:
        lanes = self.lanes
        both = gathered(lanes, "actuator_delay", "seconds")
        self.drive_delay = _steps(both + gathered(lanes, "drive_delay", "seconds"))
        self.steer_delay = _steps(both + gathered(lanes, "steering_delay", "seconds"))
        self.drive_follow = _follow(gathered(lanes, "drive_lag", "time_constant"))
        self.steer_follow = _follow(gathered(lanes, "steering_lag", "time_constant"))
        self.drive_lags, self.steer_lags = (
            follow < 1.0 if (follow < 1.0).any() else None for follow in (self.drive_follow, self.steer_follow)
        )
        self.command_gain = gathered(lanes, "speed_command_gain", "gain", 1.0)
        self.dead_zone = gathered(lanes, "drive_dead_zone", "width")
        self.steer_gain = gathered(lanes, "steering_gain", "gain", 1.0)
        self.steer_offset = gathered(lanes, "steering_offset", "angle")
        half = 0.5 * gathered(lanes, "steering_asymmetry", "difference")
        self.left, self.right = 1.0 + half, 1.0 - half
        self.stops = gathered(lanes, "steering_saturation", "limit", _FARTHEST_STEER)
        self.linked = bool((self.steer_offset != 0.0).any() or half.any() or (self.stops < _FARTHEST_STEER).any())

    def _read_forces(self) -> None:
        lanes = self.lanes
        self.quadratic = gathered(lanes, "quadratic_drag", "coefficient")
        self.viscous = gathered(lanes, "viscous_drag", "coefficient")
        self.turning = gathered(lanes, "turning_drag", "coefficient")
        self.push_x = gathered(lanes, "constant_force", "ax")
        self.push_y = gathered(lanes, "constant_force", "ay")
        self.own_mass = 1.0 + gathered(lanes, "payload", "mass_ratio")
        towed = gathered(lanes, "towed_load", "mass_ratio")
        self.train_mass = 1.0 + towed
        self.floor = gathered(lanes, "rolling_resistance", "deceleration")
        self.hitched = towed * gathered(lanes, "towed_load", "deceleration")
        self.emf = gathered(lanes, "back_emf", "coefficient")
        self.sag = gathered(lanes, "battery_sag", "rate")
        self.understeer = gathered(lanes, "understeer", "gradient")
        self.compliance = gathered(lanes, "tyre_slip", "compliance")
        self.drift_x = gathered(lanes, "crosswind_drift", "vx")
        self.drift_y = gathered(lanes, "crosswind_drift", "vy")
        self.scale = gathered(lanes, "speed_sensor_scale", "scale", 1.0)
        self.pushed = bool(self.push_x.any() or self.push_y.any())
        self.slips, self.turns_hard, self.sags = (
            bool(item.any()) for item in (self.compliance, self.turning, self.sag)
        )

    def _read_laws(self) -> None:
        """Where and when numbers hold, and how they change: what no lane has is everywhere, always, and constant."""
        lanes = self.lanes
        self.floor_per_time = gathered(lanes, "rolling_resistance", "deceleration_per_time")
        self.floor_x = [gathered(lanes, "rolling_resistance", f"x_{end}", at) for end, at in _ENDS]
        self.floor_y = [gathered(lanes, "rolling_resistance", f"y_{end}", at) for end, at in _ENDS]
        self.floor_at_x = gathered(lanes, "rolling_resistance", "at_x")
        self.floor_at_y = gathered(lanes, "rolling_resistance", "at_y")
        self.floor_radius = gathered(lanes, "rolling_resistance", "radius", np.inf)
        self.command_per_time = gathered(lanes, "speed_command_gain", "gain_per_time")
        self.steer_per_time = gathered(lanes, "steering_gain", "gain_per_time")
        self.steer_per_speed = gathered(lanes, "steering_gain", "gain_per_abs_speed")
        self.steer_above = gathered(lanes, "steering_gain", "abs_speed_above", -np.inf)
        borders = (*self.floor_x, *self.floor_y, self.floor_radius)
        self.bordered = any(np.isfinite(border).any() for border in borders)
        changes = (self.steer_per_time, self.steer_per_speed, np.isfinite(self.steer_above))
        self.steer_changes = any(item.any() for item in changes)

    def run(self) -> Trajectories:
        states = np.empty((len(self.lanes), self.rows, 4))
        for row in range(self.rows):
            self.actions[:, row] = self._driver(row)
            if row == 0:
                self.drive_felt = self._scaled_drive(self.actions[:, 0, 0], 0.0)
                self.steer_felt = self._steer_scale(0.0) * self.actions[:, 0, 1]
            states[:, row] = np.stack([self.x, self.y, self.yaw, self.scale * self.speed], axis=1)
            for step in range(self.substeps):
                self._substep(row, step)
        return Trajectories(states, self.actions)

    def _driver(self, row: int) -> FloatArray:
        """Follows the plan, but turns back far from the origin and takes fast curves wider."""
        drive = np.array([lane.commands.drive[row] for lane in self.lanes])
        steer = np.array([lane.commands.steer[row] for lane in self.lanes])
        coast = np.array([lane.commands.coast[row] for lane in self.lanes])
        pedal = np.where(coast, 0.0, np.clip(1.5 * (drive - self.speed), -1.0, 1.0))
        home = np.arctan2(-self.y, -self.x) - self.yaw
        home = np.arctan2(np.sin(home), np.cos(home))
        away = (np.hypot(self.x, self.y) > _HOME) & (np.abs(home) > 0.6) & (self.speed > 0.0)
        steer = np.where(away, np.clip(1.5 * home, -LARGEST_STEER, LARGEST_STEER), steer)
        most = np.arctan(_LATERAL * WHEELBASE / np.maximum(self.speed**2, 0.1))
        return np.stack([np.where(self.throttle, pedal, drive), np.clip(steer, -most, most)], axis=1)

    def _substep(self, row: int, step: int) -> None:
        """One step of Heun's method; what no lane has is not computed, which changes no bit of the others."""
        now = row * self.substeps + step
        drive, steer = self._felt(now)
        share = step / self.substeps
        noise = (1.0 - share) * self.disturbance[:, row] + share * self.disturbance[:, row + 1]
        motor = _Motor(drive, np.exp(-self.sag * (now * STEP)) if self.sags else None, self)
        wheels, bend = np.tan(steer), steer**2 if self.turns_hard else None
        first = self._rates(self.yaw, self.speed, motor, wheels, bend, noise)
        ahead_yaw, ahead_speed = self.yaw + STEP * first[2], self.speed + STEP * first[3]
        second = self._rates(ahead_yaw, ahead_speed, motor, wheels, bend, noise)
        self.x = self.x + 0.5 * STEP * (first[0] + second[0])
        self.y = self.y + 0.5 * STEP * (first[1] + second[1])
        self.yaw = self.yaw + 0.5 * STEP * (first[2] + second[2])
        free = self.speed + 0.5 * STEP * (first[3] + second[3])
        # dry friction takes off as much as it can and never turns a motion round: at rest it holds
        self.speed = np.sign(free) * np.maximum(np.abs(free) - STEP * self._friction(now * STEP), 0.0)

    def _friction(self, seconds: float) -> FloatArray:
        pull = np.maximum(self.floor + self.floor_per_time * seconds, 0.0)
        if self.bordered:
            inside = np.hypot(self.x - self.floor_at_x, self.y - self.floor_at_y) < self.floor_radius
            for at, ends in ((self.x, self.floor_x), (self.y, self.floor_y)):
                inside &= (at > ends[0]) & (at < ends[1])
            pull = np.where(inside, pull, 0.0)
        return np.asarray((pull + self.hitched) / self.train_mass)

    def _rates(
        self,
        yaw: FloatArray,
        speed: FloatArray,
        motor: _Motor,
        wheels: FloatArray,
        bend: FloatArray | None,
        noise: FloatArray,
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """d(x, y, yaw, speed)/dt but for dry friction; ``wheels`` is tan(steer), ``bend`` steer squared."""
        size, cosine, sine = np.abs(speed), np.cos(yaw), np.sin(yaw)
        pull = motor.pull(speed) - (self.quadratic * size + self.viscous + motor.emf) * speed
        if self.pushed:
            pull = pull + (self.push_x * cosine + self.push_y * sine)
        pull = pull / self.own_mass
        if bend is not None:
            pull = pull - self.turning * size * speed * bend
        turn = speed * wheels / (WHEELBASE + self.understeer * speed**2)
        if self.slips:
            course = yaw - np.arctan(self.compliance * speed * turn)
            cosine, sine = np.cos(course), np.sin(course)
        along_x, along_y = speed * cosine + self.drift_x, speed * sine + self.drift_y
        return along_x, along_y, turn + noise[:, 1], pull / self.train_mass + noise[:, 0]

    def _felt(self, now: int) -> tuple[FloatArray, FloatArray]:
        """Drive and steer that the mechanics feel during step ``now``: scale, delay, lag, linkage."""
        drive = self._scaled_drive(self._sent(0, now, self.drive_delay), now * STEP)
        steer = self._steer_scale(now * STEP) * self._sent(1, now, self.steer_delay)
        before_drive, before_steer = self.drive_felt, self.steer_felt
        self.drive_felt = before_drive + self.drive_follow * (drive - before_drive)
        self.steer_felt = before_steer + self.steer_follow * (steer - before_steer)
        linked = _halfway(self.drive_lags, before_drive, self.drive_felt)
        wheel = _halfway(self.steer_lags, before_steer, self.steer_felt)
        if self.linked:
            wheel = wheel + self.steer_offset
            wheel = np.where(wheel > 0.0, self.left, self.right) * wheel
            wheel = np.minimum(np.maximum(wheel, -self.stops), self.stops)
        return linked, wheel

    def _sent(self, channel: int, now: int, delay: NDArray[np.int64] | None) -> FloatArray:
        if delay is None:
            return np.asarray(self.actions[:, now // self.substeps, channel])
        row = np.maximum(now - delay, 0) // self.substeps
        return np.asarray(self.actions[self.each, row, channel])

    def _scaled_drive(self, drive: FloatArray, seconds: float) -> FloatArray:
        wanted = (self.command_gain + self.command_per_time * seconds) * drive
        if not self.throttle.any():
            return np.asarray(wanted)
        dead = np.sign(drive) * np.maximum(np.abs(drive) - self.dead_zone, 0.0)
        return np.where(self.throttle, dead, wanted)

    def _steer_scale(self, seconds: float) -> FloatArray:
        if not self.steer_changes:
            return self.steer_gain
        size = np.abs(self.speed)
        gain = self.steer_gain + self.steer_per_time * seconds + self.steer_per_speed * size
        return np.where(size > self.steer_above, gain, 1.0)


class _Motor:
    """What pulls during one step, in m/s2: a throttle the same at every speed, a servo less the nearer it is."""

    def __init__(self, drive: FloatArray, fresh: FloatArray | None, cars: _Cars) -> None:
        self.drive, self.fresh, self.cars = drive, fresh, cars
        self.throttled = bool(cars.throttle.any())
        self.emf: Any = cars.emf * np.abs(drive) * cars.throttle if self.throttled else 0.0

    def pull(self, speed: FloatArray) -> FloatArray:
        """The motor's pull at that speed; ``fresh`` is the battery's share, None where it is full."""
        gain = self.cars.gain
        pull = np.minimum(np.maximum(gain * (self.drive - speed), -ACCELERATION_LIMIT), ACCELERATION_LIMIT)
        if self.throttled:
            pull = np.where(self.cars.throttle, gain * self.drive, pull)
        return pull if self.fresh is None else pull * self.fresh


def _steps(seconds: FloatArray) -> NDArray[np.int64] | None:
    """None where nothing is late."""
    return np.rint(seconds / STEP).astype(np.int64) if seconds.any() else None


def _halfway(lags: NDArray[np.bool_] | None, before: FloatArray, after: FloatArray) -> FloatArray:
    """The mean over a step where a lane lags; elsewhere, and with None, what is there at once."""
    return after if lags is None else np.where(lags, 0.5 * (before + after), after)


def _follow(time_constant: FloatArray) -> FloatArray:
    """1 - exp(-step / time_constant); 1 where there is no lag."""
    return np.asarray(1.0 - np.exp(-STEP / np.maximum(time_constant, 1e-6)))
