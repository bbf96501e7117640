"""The gateway: one robot of the bus in front of one that speaks ROS 2.

Each period: state[k] from the newest odometry and the nominal action of the robot's own policy go to the bus, the filter's
action of tick k goes to the driver as soon as it is there. Where none comes in time, the odometry is too old, or
someone else drives, the gateway sends the brake itself. It counts ticks by its own clock, whatever the stamps say.
"""

from __future__ import annotations

import math
import os
import secrets
import time
from collections.abc import Callable, Mapping
from typing import Any, final

from safedpa.bus import ACTION, HEALTH, NOMINAL, SCAN, STATE, VERDICT, Bus, ReceivedMessage
from safedpa.bus.logging import log_event
from safedpa.bus.messages.messages import (
    ActionMessage,
    HealthMessage,
    NominalMessage,
    ScanMessage,
    StateMessage,
    VerdictMessage,
)
from safedpa.bus.messages.service_info import software_version
from safedpa.ros.face import AbstractFace
from safedpa.ros.graph import PUBLISHER
from safedpa.ros.link import RosLink, RosPublisher
from safedpa_services.ros_gateway.health_publisher import HealthPublisher
from safedpa_services.ros_gateway.robot_file import RobotFile
from safedpa_services.ros_gateway.sensor_inputs import PoseAndTwist, SensorInputs

__all__ = ["Gateway", "Limits"]

_DEADLINE_SHARE = 0.9
_LARGEST_AGE_PERIODS = 2.0
"""Between a state and the moment in which its action is sent."""
_HEARTBEAT_SECONDS = 0.25
_TOLERANCE = 1e-9
_LAST_BRAKES_SECONDS, _LONGEST_PAUSE = 1.0, 0.1
"""Commands to brake that are sent at the end, one a period."""

Limits = tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]
"""Lowest and highest of each action, and the action that brakes."""


@final
class Gateway:
    """Turns one robot; ``run`` until someone says stop."""

    def __init__(
        self,
        bus: Bus,
        link: RosLink,
        asked: RobotFile,
        face: AbstractFace,
        limits: Limits,
        sensor_inputs: SensorInputs,
        command: RosPublisher,
        health_publisher: HealthPublisher,
        period: float,
        clock: Callable[[], float] = time.monotonic,
        policy_bus: Bus | None = None,
    ) -> None:
        self._policy_bus = policy_bus or bus
        self._bus, self._link, self._asked, self._face, self._clock = bus, link, asked, face, clock
        self._low, self._high, self._brake = limits
        self._sensor_inputs, self._command, self._health_publisher = sensor_inputs, command, health_publisher
        self._nominal_type = asked.nominal.type or command.type
        self._name, self.period = asked.name, period
        self._inbox = bus.inbox((ACTION,), asked.name, alone=True)
        self._verdicts = bus.inbox((VERDICT,), asked.name, alone=True)
        self.epoch, self.tick = secrets.randbits(53), 0
        self._applied, self._applied_by = self._brake, "none"
        self._values: tuple[float, ...] = ()
        self._delay = 0.0
        self._scans = 0
        self.watchdog_ticks, self.refused = 0, 0
        self.latencies: list[float] = []
        """s from publishing a state to sending its command, of each tick that had one."""
        self.why = "it has not heard its odometry yet"
        """Why it brakes by itself now; empty while it does not."""
        self._intruder = ""
        self._next_heartbeat = clock()
        sensor_inputs.driver.answer = self._answer

    def run(self, stopped: Callable[[], bool]) -> None:
        """Drives until ``stopped``; then brakes, and falls silent."""
        begin = self._clock()
        try:
            while not stopped():
                begin = self._turn(begin)
        finally:
            pause = min(self.period, _LONGEST_PAUSE)
            for _ in range(math.ceil(_LAST_BRAKES_SECONDS / pause)):
                self._send(None)
                time.sleep(pause)
        self._report_health("braked")

    def _turn(self, begin: float) -> float:
        """One period from ``begin``; returns when the next one begins."""
        self._listen(begin)
        self._look()
        published = self._clock()
        numbers, age, stamp = self._sensor_inputs.odometry.read()
        why = self._refusal(age)
        action = None
        if not why:
            pose = self._placed(PoseAndTwist.of(numbers, self._asked.odometry.ahead))
            if math.isfinite(pose.x + pose.y + pose.yaw):
                self._publish(pose, age)
                action = self._await_action(published, begin + _DEADLINE_SHARE * self.period)
                why = "" if action is not None else "no action of the filter came in time"
            else:
                why = "the odometry's orientation is no rotation, or its position beyond all numbers"
        sent = self._drive(action, why)
        self._report_gateway(sent, age, stamp, self._clock() - published)
        self._listen(begin + _DEADLINE_SHARE * self.period)
        self.tick += 1
        following = begin + self.period
        return max(following, self._clock() - self.period)  # periods that were slept through are not made up

    def _refusal(self, age: float) -> str:
        if self._intruder:
            return self._intruder
        if age > self._asked.odometry.largest_age:
            reported = f"{age:.2f} s old" if math.isfinite(age) else "never there"
            because = f"; {self._sensor_inputs.odometry.why}" if self._sensor_inputs.odometry.why else ""
            return f"the odometry is {reported}{because}"
        if self._sensor_inputs.localised is not None:
            asked, old = self._asked.localisation, self._sensor_inputs.localised.read()[1]
            if old > asked.largest_age:
                reported = f"{old:.2f} s old" if math.isfinite(old) else "never there"
                because = f"; {self._sensor_inputs.localised.why}" if self._sensor_inputs.localised.why else ""
                return f"the transform from {asked.frame} to {self._asked.wire.frame} is {reported}{because}"
        return ""

    def _placed(self, pose: PoseAndTwist) -> PoseAndTwist:
        """The pose in the frame of the surroundings."""
        localised = self._sensor_inputs.localised
        return pose if localised is None else pose.seen_from(localised.read()[0])

    def _publish(self, pose: PoseAndTwist, age: float) -> None:
        asked, around = self._asked, self._asked.surroundings
        self._values = self._face.state(pose.x, pose.y, pose.yaw, pose.speed, pose.yaw_rate)
        stamp: dict[str, Any] = {
            "epoch": self.epoch,
            "tick": self.tick,
            "robot_time": self.tick * self.period,
            "publish_time": time.time(),
        }
        goal = self._sensor_inputs.goal.read()[0] if self._sensor_inputs.goal is not None else ()
        state = StateMessage(
            **stamp,
            values=self._values,
            applied=self._applied,
            applied_by=self._applied_by,
            period=self.period,
            lockstep=False,
            goal=goal or around.goal,
            obstacles=around.obstacles,
            field=around.field,
            footprint=around.footprint,
            until_action=age + self._delay,
            sources=tuple(scan.name for scan in asked.scans),
        )
        self._publish_scans(age)
        self._bus.publish(STATE, self._name, state)
        if self._sensor_inputs.nominal is None:
            return
        numbers, nominal_age, _ = self._sensor_inputs.nominal.read()
        if nominal_age <= asked.nominal.largest_age:
            nominal = self._face.action(self._nominal_type, numbers, self._values)
            self._policy_bus.publish(NOMINAL, self._name, NominalMessage(**stamp, values=nominal, controller="ros"))

    def _publish_scans(self, age: float) -> None:
        """What the scanners told since the last state, on the same clock as the states: when each was measured."""
        now = self._clock()
        for asked, scanner in zip(self._asked.scans, self._sensor_inputs.scanners, strict=True):
            for turn in scanner.taken():
                measured = self.tick * self.period + min(0.0, turn.arrived - asked.delay - (now - age))
                if measured < 0.0:
                    continue  # before the first state there is no place at which it was measured
                self._scans += 1
                message = ScanMessage(
                    epoch=self.epoch,
                    tick=int(measured / self.period),
                    robot_time=measured,
                    publish_time=time.time(),
                    source=asked.name,
                    mount=asked.mount,
                    first_angle=turn.first_angle,
                    angle_step=turn.angle_step,
                    ranges=turn.ranges,
                    nearest=turn.nearest,
                    farthest=turn.farthest,
                    number=self._scans,
                )
                self._bus.publish(SCAN, self._name, message)

    def _await_action(self, published: float, deadline: float) -> tuple[float, ...] | None:
        while (left := deadline - self._clock()) > 0.0:
            for item in self._inbox.take(left):
                if not isinstance(item, ReceivedMessage) or not isinstance(item.message, ActionMessage):
                    self.refused += 1
                    continue
                if self._clock() - published > _LARGEST_AGE_PERIODS * self.period:
                    self.refused += 1  # this process was held up: what it saw is long past
                    return None
                if self._fits(item.message):
                    self.latencies.append(self._clock() - published)
                    self._delay += 0.1 * (self.latencies[-1] - self._delay)
                    return item.message.values
                self.refused += 1
        return None

    def _fits(self, message: ActionMessage) -> bool:
        """Whether it was computed from this tick's state, and is within the limits. Nothing is clipped."""
        if (message.epoch, message.tick) != (self.epoch, self.tick) or len(message.values) != len(self._low):
            return False
        return all(
            low - _TOLERANCE <= value <= high + _TOLERANCE
            for value, low, high in zip(message.values, self._low, self._high, strict=True)
        )

    def _drive(self, action: tuple[float, ...] | None, why: str) -> int:
        """Sends the action, or the brake; the stamp of what was sent [ns]."""
        sent = self._send(action)
        self._applied, self._applied_by = (self._braking()[0], "watchdog") if action is None else (action, "filter")
        if action is None:
            self.watchdog_ticks += 1
        if why[:16] != self.why[:16]:  # the same reason with another number is no news
            kind, level = ("robot.brakes", "warning") if why else ("robot.drives", "info")
            sentence = f"the gateway brakes: {why}" if why else "the filter drives"
            log_event(kind, sentence, level=level, robot=self._name, tick=self.tick, service="robot")
        self.why = why
        return sent

    def _braking(self) -> tuple[tuple[float, ...], Mapping[str, Any]]:
        """The action that brakes, and the fields of its command."""
        return self._face.brake(self._command.type, self._brake, self._values)

    def _send(self, action: tuple[float, ...] | None) -> int:
        """None: the brake. The stamp of what was sent [ns]."""
        fields = self._braking()[1] if action is None else self._face.message(self._command.type, action, self._values)
        values = dict(fields)
        now = time.time_ns()
        if self._command.type.endswith("Stamped"):
            values["header"] = self._health_publisher.head(now)
        self._command.put(values)
        return now

    def _answer(self) -> None:
        """A brake at once for each command of someone else, so that it is in force for a moment only."""
        self._send(None)

    def _report_gateway(self, sent: int, age: float, stamp: int, seconds: float) -> None:
        facts = {
            "tick": str(self.tick),
            "odometry_stamp": str(stamp),
            "odometry_age": f"{age:.6f}",
            "sense_to_act": f"{age + seconds:.6f}",
            "command_stamp": str(sent),
            "periods_braked": str(self.watchdog_ticks),
            **self._sensor_inputs.not_believed([scan.name for scan in self._asked.scans]),
        }
        self._health_publisher.gateway(self.why, facts)

    def _look(self) -> None:
        """Whether someone else speaks on the driver's topic, as far as is known without asking anybody now."""
        topic = self._asked.command.topic
        others = self._link.watched(topic, PUBLISHER) if self._link.form == "rmw_zenoh" else []
        named = f"{others[0].node} publishes on {topic} too; remap it to another topic" if others else ""
        self._intruder = named or self._sensor_inputs.driver.why

    def _listen(self, until: float) -> None:
        """Verdicts to the robot's people, a heartbeat to the bus, until then."""
        while True:
            left = until - self._clock()
            for item in self._verdicts.take(max(0.0, left)):
                if isinstance(item, ReceivedMessage) and isinstance(item.message, VerdictMessage):
                    self._health_publisher.verdict(item.message)
            if self._clock() >= self._next_heartbeat:
                self._next_heartbeat = self._clock() + _HEARTBEAT_SECONDS
                self._report_health("running")
            if self._clock() >= until:
                return

    def _report_health(self, state: str) -> None:
        reported, self.latencies = tuple(self.latencies[-100:]), []
        message = HealthMessage(
            epoch=self.epoch,
            tick=self.tick,
            robot_time=self.tick * self.period,
            publish_time=time.time(),
            service="robot",
            pid=os.getpid(),
            state=state,
            detail=self.why,
            steps=self.tick,
            stale=self.watchdog_ticks,
            refused=self.refused + self._sensor_inputs.refused,
            software=software_version(),
            latencies=reported,
        )
        self._bus.publish(HEALTH, self._name, message, "robot")
