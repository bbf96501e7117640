"""A simulated laser scanner with noise, drop-outs, blind sectors and latency."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass
from math import cos, inf, isfinite, pi, sin
from typing import final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.bus.messages.messages import ScanMessage
from safedpa.errors import InputError
from safedpa_sim.sensing.shapes import Outline, cast

MOST_RAYS = 1080
NOTHING_BELIEVED = -1.0
"""m; marks a range that was dropped or lies in a blind sector."""


@final
@dataclass(frozen=True)
class LaserSettings:
    """Settings of a scanner. Raises InputError naming a setting that is out of range."""

    name: str = "laser"
    mount: tuple[float, float, float] = (0.12, 0.0, 0.0)
    """x ahead of the reference point, y to its left [m], yaw [rad]."""
    field_of_view: float = 2.0 * pi
    """rad, symmetric about the sensor's angle 0."""
    rays: int = 360
    rate: float = 10.0
    """Hz; independent of the robot's ticks."""
    noise: float = 0.02
    """m; standard deviation of each range."""
    drop_outs: float = 0.05
    """Probability that a ray measures nothing."""
    latency: float = 0.05
    """s from the measurement to the scan message."""
    nearest: float = 0.05
    """m"""
    farthest: float = 12.0
    """m"""
    blind: tuple[tuple[float, float], ...] = ()
    """Blind sectors: first and last angle [rad] in the sensor frame."""
    clockwise: bool = False
    """Whether the angles increase to the right, as for a scanner mounted upside down."""

    def __post_init__(self) -> None:
        for name, low, high in (
            ("field_of_view", 1e-3, 2.0 * pi),
            ("rays", 2, MOST_RAYS),
            ("rate", 1.0, 40.0),
            ("noise", 0.0, 1.0),
            ("drop_outs", 0.0, 1.0),
            ("latency", 0.0, 1.0),
            ("nearest", 0.0, 10.0),
            ("farthest", self.nearest, 1e3),
        ):
            value = getattr(self, name)
            if not (isfinite(value) and low <= value <= high):
                raise InputError(f"laser {name}: got {value}, wanted {low:g} to {high:g}")

    @property
    def step(self) -> float:
        """Angle [rad] from one ray to the next, to the left."""
        whole = (
            self.field_of_view >= 2.0 * pi - 1e-9
        )  # over a full circle the last ray must not coincide with the first
        return self.field_of_view / (self.rays if whole else self.rays - 1)


@final
class Laser:
    """A scanner that measures at 0 s, 1 / rate, 2 / rate ... and reports each scan ``latency`` later.

    All rays of a scan are measured at once. The noise depends on the seed only, not on when scans are read.
    """

    def __init__(self, settings: LaserSettings, seed: int = 0) -> None:
        self.settings = settings
        self._draw = np.random.default_rng([seed, 7])
        self._number = 0
        self._waiting: deque[ScanMessage] = deque()
        own: FloatArray = -0.5 * settings.field_of_view + settings.step * np.arange(settings.rays, dtype=np.float64)
        self._angles = own
        self._blinded = np.zeros(settings.rays, dtype=bool)
        for first, last in settings.blind:
            self._blinded |= (own >= first) & (own <= last)

    @property
    def next_scan(self) -> float:
        """Robot time [s] of the next measurement."""
        return self._number / self.settings.rate

    def scan(self, pose: tuple[float, float, float], outline: Outline, epoch: int, tick: int) -> None:
        """Measures ``outline`` at ``next_scan`` from the body's pose (x, y [m], yaw [rad])."""
        own = self.settings
        x, y, yaw = pose
        ahead, aside, turned = own.mount
        sensor_x, sensor_y = x + ahead * cos(yaw) - aside * sin(yaw), y + ahead * sin(yaw) + aside * cos(yaw)
        angles: FloatArray = self._angles + (yaw + turned)
        true = cast(outline, sensor_x, sensor_y, angles)
        seen = true + self._draw.normal(0.0, 1.0, own.rays) * own.noise
        seen = np.where((true > own.farthest) | (true == inf), own.farthest, np.clip(seen, 0.0, own.farthest))
        dropped = self._draw.random(own.rays) < own.drop_outs
        seen[dropped | self._blinded | (seen < own.nearest)] = NOTHING_BELIEVED
        sign = -1.0 if own.clockwise else 1.0
        ranges = seen[::-1] if own.clockwise else seen
        first = self._angles[-1] if own.clockwise else self._angles[0]
        message = ScanMessage(
            epoch=epoch,
            tick=tick,
            robot_time=self.next_scan,
            publish_time=time.time(),
            source=own.name,
            mount=own.mount,
            first_angle=float(first),
            angle_step=sign * own.step,
            ranges=tuple(ranges.tolist()),
            nearest=own.nearest,
            farthest=own.farthest,
            number=self._number,
        )
        self._number += 1
        self._waiting.append(message)

    def reported(self, now: float) -> list[ScanMessage]:
        """Returns the scans due at robot time ``now`` [s], each once, in order."""
        due = []
        while self._waiting and self._waiting[0].robot_time + self.settings.latency <= now + 1e-9:
            due.append(self._waiting.popleft())
        return due
