"""A localisation that confirms where the robot is, after its state was implausible."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from typing import Final, final

from safedpa.bus import Bus, Request
from safedpa.bus.logging import log_event
from safedpa.bus.messages.requests import CONFIRM
from safedpa.errors import BusError, InputError
from safedpa.records.readers.bags.messages import yaw_of
from safedpa_services.ros_gateway.robot_file import ConfirmationTopic
from safedpa_services.ros_gateway.sensor_inputs import LatestMessage, PoseAndTwist

__all__ = ["CONFIRMED_POSE", "PoseConfirmation"]

CONFIRMED_POSE: Final = "geometry_msgs/msg/PoseWithCovarianceStamped"
_LARGEST_AGE: Final = 1.0
"""s; an older pose says nothing about where the robot is now."""
_PAUSE: Final = 1.0
"""Shortest time between two requests [s]."""
_ANSWER_SECONDS: Final = 1.0


def _paths() -> tuple[str, ...]:
    turn = tuple(f"pose.pose.orientation.{axis}" for axis in "xyzw")
    return ("pose.pose.position.x", "pose.pose.position.y", *turn)


@final
class PoseConfirmation:
    """Asks the safety filter to ``confirm`` an implausible state, once a declared pose agrees with it.

    A pose agrees if it is at most ``distance`` [m] and ``angle`` [rad] from the one that the state has. The filter
    refuses where anything else than an implausible state stops the robot, such as the order of a person. Only a pose
    that arrived since the state became implausible counts, and no pose counts twice: one that is frozen like the state
    would let the robot drive again and again.
    """

    def __init__(
        self,
        bus: Bus,
        robot: str,
        topic: ConfirmationTopic,
        frame: str,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._bus, self._robot, self._topic, self._clock = bus, robot, topic, clock
        self.input = LatestMessage(CONFIRMED_POSE, _paths(), frame, clock)
        self._seen: tuple[float, ...] = ()
        """The last pose that was compared."""
        self._next, self._since, self._checked = -math.inf, math.inf, -math.inf

    def check(self, pose: PoseAndTwist) -> None:
        """Compares the newest confirmed pose with the one of an implausible state, in each period; never blocks."""
        numbers, age, _ = self.input.read()
        now = self._clock()
        if now - self._checked > _PAUSE:
            self._since = now  # the state has become implausible
        self._checked = now
        new = numbers and numbers != self._seen and age <= _LARGEST_AGE and now - age >= self._since
        if not new or now < self._next:
            return
        self._seen, self._next = numbers, now + _PAUSE
        x, y, *quaternion = numbers
        apart = math.hypot(pose.x - x, pose.y - y)
        turned = abs(math.remainder(pose.yaw - yaw_of(*quaternion), math.tau))
        if apart <= self._topic.distance and turned <= self._topic.angle:
            threading.Thread(target=self._ask, name="confirm", daemon=True).start()
        else:
            self._tell(
                f"the pose on {self._topic.topic} is {apart:.2g} m and {turned:.2g} rad from the state: not confirmed",
                "warning",
            )

    def _ask(self) -> None:
        try:
            request = Request(do="confirm", who=self._topic.topic)
            answer = self._bus.request(self._robot, request, _ANSWER_SECONDS, CONFIRM)
        except (BusError, InputError) as error:
            self._tell(f"the pose on {self._topic.topic} could not be confirmed: {error}", "warning")
            return
        if answer is not None and answer.ok:
            self._tell(f"the pose on {self._topic.topic} agrees with the state: {answer.sentence}", "info")

    def _tell(self, sentence: str, level: str) -> None:
        log_event("robot.confirmed_pose", sentence, level=level, robot=self._robot, service="robot")
