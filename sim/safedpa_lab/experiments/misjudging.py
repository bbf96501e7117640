"""A simulated car whose odometry is wrong: what it tells of its place drifts away from where it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import cos, sin
from typing import final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.bus import ActionMessage, ScanMessage, StateMessage
from safedpa.perception.odometry import Pose
from safedpa_sim.robots.core import CarRobot

__all__ = ["Misjudges", "placed"]


@final
class Misjudges:
    """Tells of each metre and m/s ``1 + stretch`` of it, and of each radian ``1 + turning`` of it.

    Its frame is the true one at first. Goals are told in the frame that it believes in, as by someone who points there
    from where it is. What its laser measures is true.
    """

    def __init__(self, car: CarRobot, stretch: float, turning: float) -> None:
        self.car = car
        self._stretch, self._turning = 1.0 + stretch, 1.0 + turning
        x, y, yaw, _ = car.values
        self._true: Pose = (x, y, yaw)
        self._reported: Pose = (x, y, yaw)

    @property
    def true_pose(self) -> Pose:
        """Where it is: x, y [m], yaw [rad]."""
        x, y, yaw, _ = self.car.values
        return x, y, yaw

    @property
    def reported_pose(self) -> Pose:
        """Where it believes to be."""
        now = self.true_pose
        if now != self._true:
            (x, y, yaw), (before_x, before_y, before_yaw) = now, self._true
            aside = self._reported[2] - before_yaw
            way_x, way_y = self._stretch * (x - before_x), self._stretch * (y - before_y)
            self._reported = (
                self._reported[0] + way_x * cos(aside) - way_y * sin(aside),
                self._reported[1] + way_x * sin(aside) + way_y * cos(aside),
                self._reported[2] + self._turning * (yaw - before_yaw),
            )
            self._true = now
        return self._reported

    def in_reported_frame(self, places: FloatArray) -> FloatArray:
        """(n, 2) m; where true ``places`` (n, 2) [m] lie in the frame that it believes in, as seen from it now."""
        reported, true = self.reported_pose, self.true_pose
        believed: FloatArray = placed(places - np.array(true[:2]), reported[2] - true[2]) + np.array(reported[:2])
        return believed

    def state_message(self) -> StateMessage:
        """State k as it is told; the pose of a load is for pictures only, and left out."""
        message = self.car.state_message()
        goal = self.in_reported_frame(np.array([message.goal]))[0]
        values = (*self.reported_pose, self._stretch * message.values[3])
        return replace(message, values=values, goal=tuple(goal.tolist()), load_pose=())

    def scans(self) -> Sequence[ScanMessage]:
        """What the car's sensors have to tell."""
        return self.car.scans()

    def receive(self, message: ActionMessage) -> str | None:
        """Accepts an action, or says why not."""
        return self.car.receive(message)

    def advance(self) -> None:
        """Lives through one period."""
        self.car.advance()


def placed(places: FloatArray, angle: float) -> FloatArray:
    """(n, 2) ``places`` turned by ``angle`` [rad] around the origin."""
    cosine, sine = cos(angle), sin(angle)
    turned: FloatArray = places @ np.array([[cosine, sine], [-sine, cosine]])
    return turned
