"""The gateway: makes a robot that uses ROS 2 a robot of the bus.

In each period it publishes state[k] from the newest odometry, and the nominal action of the robot's own policy. It
sends the filter's action of tick k to the driver as soon as it arrives. If no action arrives in time, the odometry is
too old, or another node sends commands, the gateway sends the braking command itself. Ticks follow the gateway's own
clock, not the stamps of messages.
"""

from __future__ import annotations

import math
import os
import re
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
    StateMessage,
    VerdictMessage,
)
from safedpa.bus.messages.service_info import software_version
from safedpa.ros.definitions import plain_type
from safedpa.ros.encoding import stamp_of
from safedpa.ros.face import AbstractFace
from safedpa.ros.graph import PUBLISHER
from safedpa.ros.link import RosLink, RosPublisher
from safedpa.ros.outgoing import diagnostics_of, gateway_diagnostics, path_marker
from safedpa.runtime.stop_orders import IMPLAUSIBLE
from safedpa_services.ros_gateway.gateway_inputs import SensorInputs
from safedpa_services.ros_gateway.pose_confirmation import PoseConfirmation
from safedpa_services.ros_gateway.robot_file import RobotFile
from safedpa_services.ros_gateway.sensor_inputs import PoseAndTwist
from safedpa_services.ros_gateway.speed_zones import Limit, scaled, velocity_of

TWIST = "geometry_msgs/msg/Twist"
_MARKER_SECONDS = 0.1
"""Shortest time between two markers [s]."""


@final
class HealthPublisher:
    """Publishes on the topics for diagnostics and markers, if the robot's file names them."""

    def __init__(
        self,
        robot: str,
        frame: str,
        face: AbstractFace,
        diagnostics: RosPublisher | None,
        markers: RosPublisher | None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._robot, self._frame, self._face, self._clock = robot, frame, face, clock
        self._diagnostics, self._markers = diagnostics, markers
        self._next_marker = clock()

    def head(self, nanoseconds: int = 0) -> dict[str, Any]:
        """Returns a message header in the frame of the surroundings, stamped with the given time (0: now)."""
        return {"stamp": stamp_of(nanoseconds or time.time_ns()), "frame_id": self._frame}

    def verdict(self, verdict: VerdictMessage) -> None:
        """Publishes a verdict of the filter, and the predicted path."""
        if self._diagnostics is not None:
            self._diagnostics.put(diagnostics_of(self.head(), self._robot, verdict))
        if self._markers is not None and verdict.predicted and self._clock() >= self._next_marker:
            self._next_marker = self._clock() + _MARKER_SECONDS
            try:
                places = [self._face.planar(row)[:2] for row in verdict.predicted]
            except IndexError:  # states of another model: a marker must not end the drive
                return
            self._markers.put({"markers": [path_marker(self.head(), places)]})

    def gateway(self, why: str, facts: dict[str, str]) -> None:
        """Publishes the state of the gateway; ``why`` it brakes, empty if the filter drives."""
        if self._diagnostics is not None:
            self._diagnostics.put(gateway_diagnostics(self.head(), self._robot, why, facts))


_NUMBER = re.compile(r"[\d.]+")
_DEADLINE_SHARE = 0.9
_LARGEST_AGE_PERIODS = 2.0
"""Largest age of a state, in periods, when its action is sent."""
_HEARTBEAT_SECONDS = 0.25
_NOTE_SECONDS = 1.5
"""Shortest time between two reports of other types [s]; the log takes one of a kind each second."""
_TOLERANCE = 1e-9
_LAST_BRAKES_SECONDS, _LONGEST_PAUSE = 1.0, 0.1
"""At the end, braking commands are sent for this time [s], with this longest pause [s] between two."""

Limits = tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]
"""Lowest and highest actions, and the braking action."""


@final
class Gateway:
    """Drives one robot; see ``run``."""

    def __init__(
        self,
        bus: Bus,
        link: RosLink,
        robot_file: RobotFile,
        face: AbstractFace,
        limits: Limits,
        sensor_inputs: SensorInputs,
        command: RosPublisher,
        health_publisher: HealthPublisher,
        period: float,
        clock: Callable[[], float] = time.monotonic,
        policy_bus: Bus | None = None,
        zone_state: RosPublisher | None = None,
        confirmation: PoseConfirmation | None = None,
    ) -> None:
        self._confirmation = confirmation
        self._ordered = ""
        """Reason of the stop order in the newest verdict."""
        self._policy_bus, self._zone_state, self._limit = policy_bus or bus, zone_state, Limit()
        self._wall = time.monotonic if sensor_inputs.simulated is not None else clock
        """Clock of heartbeats, which must not stop with simulated time."""
        self._restarts, self._notes, self._next_note = 0, set[str](), -math.inf
        self._bus, self._link, self._robot_file, self._face, self._clock = bus, link, robot_file, face, clock
        self._low, self._high, self._brake = limits
        self._sensor_inputs, self._command, self._health_publisher = sensor_inputs, command, health_publisher
        self._nominal_type = robot_file.nominal.type or command.type
        self._name, self.period = robot_file.name, period
        self._inbox = bus.inbox((ACTION,), robot_file.name, alone=True)
        self._verdicts = bus.inbox((VERDICT,), robot_file.name, alone=True)
        self.epoch, self.tick = secrets.randbits(53), 0
        self._applied, self._applied_by = self._brake, "none"
        self._values: tuple[float, ...] = ()
        self._delay = 0.0
        self._scans = 0
        self.watchdog_ticks, self.refused = 0, 0
        self.latencies: list[float] = []
        """Time from publishing a state to sending its command, for each tick with an action [s]."""
        self.why = "no odometry has arrived yet"
        """Why the gateway brakes; empty while the filter drives."""
        self._intruder = ""
        self._next_heartbeat = self._wall()
        # At once after a command of another publisher, so that it acts for a moment only.
        sensor_inputs.driver.answer = lambda: self._send(None)

    def run(self, stopped: Callable[[], bool]) -> None:
        """Drives until ``stopped``, then sends braking commands for a second."""
        begin = self._clock()
        try:
            while not stopped():
                begin = self.turn(begin)
        finally:
            pause = min(self.period, _LONGEST_PAUSE)
            for _ in range(math.ceil(_LAST_BRAKES_SECONDS / pause)):
                self._send(None)
                time.sleep(pause)
        self._report_health("braked")

    def turn(self, begin: float) -> float:
        """Runs one period that starts at ``begin`` [s]; returns the start of the next one."""
        self._listen(begin)
        begin = self._skip_missed(begin)
        self._check_intruder()
        self._check_types()
        self._check_restart()
        published = self._clock()
        numbers, age, stamp = self._sensor_inputs.odometry.read()
        why = self._refusal(age)
        action = None
        if not why:
            pose, localised = PoseAndTwist.of(numbers, self._robot_file.odometry.ahead), self._sensor_inputs.localised
            pose = pose if localised is None else pose.seen_from(localised.read()[0])
            if math.isfinite(pose.x + pose.y + pose.yaw):
                self._publish(pose, age)
                action = self._await_action(published, begin + _DEADLINE_SHARE * self.period)
                why = "" if action is not None else "no action of the filter arrived in time"
                if IMPLAUSIBLE in self._ordered:
                    if self._confirmation is not None:
                        self._confirmation.check(pose)
                    if self._face.needs_speed:
                        action, why = None, "the state is implausible, and the command of an action needs its speed"
            else:
                why = "the odometry's orientation is not a rotation, or its position is not finite"
        sent = self._drive(action, why)
        self._report_gateway(sent, age, stamp, self._clock() - published)
        self._listen(begin + _DEADLINE_SHARE * self.period)
        self.tick += 1
        return begin + self.period

    def _skip_missed(self, begin: float) -> float:
        """Returns the begin of the present period [s] if the process was held up since ``begin``; counts the ticks.

        Otherwise the filter would compare a motion of several periods with its prediction for one.
        """
        missed = max(0, math.floor((self._clock() - begin) / self.period))
        self.tick += missed
        return begin + missed * self.period

    def _refusal(self, age: float) -> str:
        if self._intruder:
            return self._intruder
        simulated = self._sensor_inputs.simulated
        if simulated is not None and simulated.why:
            return simulated.why
        return self._odometry_refusal(age) or self._footprint_refusal()

    def _footprint_refusal(self) -> str:
        footprint = self._sensor_inputs.footprint
        old = 0.0 if footprint is None else footprint.read()[1]
        if footprint is None or old <= self._robot_file.footprint.largest_age:
            return ""
        state = f"{old:.2f} s old" if math.isfinite(old) else "missing"
        return f"the footprint is {state}{f'; {footprint.why}' if footprint.why else ''}"

    def _odometry_refusal(self, age: float) -> str:
        if age > self._robot_file.odometry.largest_age:
            state = f"{age:.2f} s old" if math.isfinite(age) else "missing"
            because = f"; {self._sensor_inputs.odometry.why}" if self._sensor_inputs.odometry.why else ""
            return f"the odometry is {state}{because}"
        if self._sensor_inputs.odometry.clock:
            return f"the odometry is implausible: {self._sensor_inputs.odometry.clock}"
        if self._sensor_inputs.localised is not None:
            topic, old = self._robot_file.localisation, self._sensor_inputs.localised.read()[1]
            if old > topic.largest_age:
                state = f"{old:.2f} s old" if math.isfinite(old) else "missing"
                because = f"; {self._sensor_inputs.localised.why}" if self._sensor_inputs.localised.why else ""
                return f"the transform from {topic.frame} to {self._robot_file.wire.frame} is {state}{because}"
        return ""

    def _publish(self, pose: PoseAndTwist, age: float) -> None:
        robot_file, around = self._robot_file, self._robot_file.surroundings
        self._values = self._face.state_moving_aside(pose.x, pose.y, pose.yaw, pose.speed, pose.aside, pose.yaw_rate)
        footprint = self._sensor_inputs.footprint
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
            footprint=around.footprint if footprint is None else footprint.read()[0],
            until_action=age + self._sensor_inputs.odometry.lag + self._delay,
            sources=tuple(sensor.name for sensor in robot_file.sensors),
        )
        self._publish_scans(age)
        self._bus.publish(STATE, self._name, state)
        if self._sensor_inputs.nominal is None:
            return
        kind = self._sensor_inputs.nominal.type or self._nominal_type
        numbers, nominal_age, _ = self._sensor_inputs.nominal.read()
        if nominal_age <= robot_file.nominal.largest_age:
            numbers = self._limited(kind, numbers)
            nominal = self._face.action(kind, numbers, self._values)
            self._policy_bus.publish(NOMINAL, self._name, NominalMessage(**stamp, values=nominal, controller="ros"))

    def _limited(self, kind: str, numbers: tuple[float, ...]) -> tuple[float, ...]:
        """Returns the fields of the nominal command after the speed zones, and reports a change of the acting zone."""
        zones = self._sensor_inputs.zones
        if zones is None:
            return numbers
        counted = self._sensor_inputs.counted
        pose = PoseAndTwist.of(self._sensor_inputs.odometry.read()[0], self._robot_file.odometry.ahead)
        here, points, silent = (pose.x, pose.y, pose.yaw), {}, ""
        for topic, sensor in zip(self._robot_file.sensors, self._sensor_inputs.sources, strict=True):
            if topic.name in counted and not counted[topic.name].on:
                continue
            newest, age = sensor.newest()
            if newest is None or age > topic.time_out:
                silent = silent or topic.name
            else:
                points[topic.name] = newest.points_at(here)
        twist = self._face.message(TWIST, self._face.action(kind, numbers, self._values), self._values)
        limit = zones.limit(velocity_of(twist), points)
        if silent:
            limit = Limit(0.0, "stop", "invalid source")
        if (limit.action, limit.zone) != (self._limit.action, self._limit.zone):
            log_event(
                "robot.zone",
                f"zone {limit.zone}: {limit.action} ({limit.share:.2f} of the nominal velocity)" if limit.zone
                else "no speed zone acts",
                robot=self._name, tick=self.tick, service="robot",
            )  # fmt: skip
            if self._zone_state is not None:
                self._zone_state.put({"action_type": limit.number, "polygon_name": limit.zone})
        self._limit = limit
        return scaled(numbers, self._face.paths(kind), limit.share)

    def _publish_scans(self, age: float) -> None:
        """Publishes the scans since the last state, stamped with their time of measurement in robot time."""
        now = self._clock()
        for topic, sensor in zip(self._robot_file.sensors, self._sensor_inputs.sources, strict=True):
            for reading in sensor.take_all():
                measured = self.tick * self.period + min(0.0, reading.arrived - topic.delay - (now - age))
                if measured < 0.0:
                    continue  # measured before the first state, at an unknown pose
                self._scans += 1
                at = (self._scans, self.epoch, int(measured / self.period), measured)
                self._bus.publish(SCAN, self._name, reading.rays.message(topic.name, *at))

    def _await_action(self, published: float, deadline: float) -> tuple[float, ...] | None:
        while (left := deadline - self._clock()) > 0.0:
            for item in self._inbox.take(left):
                if not isinstance(item, ReceivedMessage) or not isinstance(item.message, ActionMessage):
                    self.refused += 1
                    continue
                if self._clock() - published > _LARGEST_AGE_PERIODS * self.period:
                    self.refused += 1  # this process was suspended; the state is outdated
                    return None
                if self._fits(item.message):
                    self.latencies.append(self._clock() - published)
                    self._delay += 0.1 * (self.latencies[-1] - self._delay)
                    return item.message.values
                self.refused += 1
        return None

    def _fits(self, message: ActionMessage) -> bool:
        """Returns whether an action is for this tick and within the limits; actions are not clipped."""
        if (message.epoch, message.tick) != (self.epoch, self.tick) or len(message.values) != len(self._low):
            return False
        return all(
            low - _TOLERANCE <= value <= high + _TOLERANCE
            for value, low, high in zip(message.values, self._low, self._high, strict=True)
        )

    def _drive(self, action: tuple[float, ...] | None, why: str) -> int:
        """Sends the action, or the braking command if None; returns the stamp of the command [ns]."""
        sent = self._send(action)
        self._applied, self._applied_by = (self._braking()[0], "watchdog") if action is None else (action, "filter")
        if action is None:
            self.watchdog_ticks += 1
        if _NUMBER.sub("", why) != _NUMBER.sub("", self.why):  # the same reason with another number is not logged again
            kind, level = ("robot.brakes", "warning") if why else ("robot.drives", "info")
            sentence = f"the gateway brakes: {why}" if why else "the filter drives"
            log_event(kind, sentence, level=level, robot=self._name, tick=self.tick, service="robot")
        self.why = why
        return sent

    def _braking(self) -> tuple[tuple[float, ...], Mapping[str, Any]]:
        """Returns the braking action, and the fields of its command."""
        return self._face.brake(self._command.type, self._brake, self._values)

    def _send(self, action: tuple[float, ...] | None) -> int:
        """Sends an action (None: the braking command); returns the stamp of the command [ns]."""
        fields = self._braking()[1] if action is None else self._face.message(self._command.type, action, self._values)
        values = dict(fields)
        simulated = self._sensor_inputs.simulated
        now = time.time_ns() if simulated is None else simulated.nanoseconds
        if self._command.type.endswith("Stamped"):
            values["header"] = self._health_publisher.head(now)
        self._command.put(values)
        return now

    def _report_gateway(self, sent: int, age: float, stamp: int, seconds: float) -> None:
        facts = {
            "tick": str(self.tick),
            "odometry_stamp": str(stamp),
            "odometry_age": f"{age:.6f}",
            "sense_to_act": f"{age + seconds:.6f}",
            "command_stamp": str(sent),
            "periods_braked": str(self.watchdog_ticks),
            **self._zone_facts(),
            **self._sensor_inputs.refusals([sensor.name for sensor in self._robot_file.sensors]),
        }
        self._health_publisher.gateway(self.why, facts)

    def _zone_facts(self) -> dict[str, str]:
        zones = self._sensor_inputs.zones
        if zones is None:
            return {}
        missing = zones.missing()
        facts = {"zone": f"{self._limit.action} {self._limit.zone}".strip()}
        return {**facts, "zone_refused": missing} if missing else facts

    def _check_intruder(self) -> None:
        """Checks for another publisher on the driver's topic, without blocking."""
        topic = self._robot_file.command.topic
        others = self._link.watched(topic, PUBLISHER) if self._link.form == "rmw_zenoh" else []
        named = f"{others[0].node} publishes on {topic}, too; remap it to another topic" if others else ""
        self._intruder = named or self._sensor_inputs.driver.why

    def _check_types(self) -> None:
        """Reports publishers of the nominal action or odometry with another type than the file says, each once."""
        nominal, link = self._robot_file.nominal, self._link
        if link.form != "rmw_zenoh" or self._wall() < self._next_note:
            return
        wanted = [(self._robot_file.odometry.topic, (self._robot_file.odometry.type,))]
        if nominal.topic:
            wanted.append((nominal.topic, (self._nominal_type,)))
        wanted += [(one.topic, (one.type,)) for one in self._robot_file.sensors]
        for topic, types in wanted:
            for other in link.watched(topic, PUBLISHER):
                kind = plain_type(other.type)
                if kind in map(plain_type, types) or f"{other.node} {kind}" in self._notes:
                    continue
                self._notes.add(f"{other.node} {kind}")
                served = topic == nominal.topic and kind in self._face.commands
                what = "it is used" if served else "it is not used"
                self._next_note = self._wall() + _NOTE_SECONDS
                sentence = f"{other.node} publishes {kind} on {topic}, the file says {types[0]}: {what}"
                log_event(
                    "robot.other_type", sentence, level="warning", robot=self._name, tick=self.tick, service="robot"
                )
                return

    def _check_restart(self) -> None:
        """Begins a new epoch if simulated time jumped: the simulation was reset, and the robot is elsewhere."""
        simulated = self._sensor_inputs.simulated
        if simulated is not None and simulated.restarts != self._restarts:
            self._restarts = simulated.restarts
            self.epoch, self.tick = secrets.randbits(53), 0
            self._applied, self._applied_by = self._brake, "none"

    def _listen(self, until: float) -> None:
        """Forwards verdicts to ROS and sends heartbeats to the bus, until a time."""
        while True:
            left = until - self._clock()
            for item in self._verdicts.take(max(0.0, left)):
                if isinstance(item, ReceivedMessage) and isinstance(item.message, VerdictMessage):
                    self._ordered = item.message.ordered
                    self._health_publisher.verdict(item.message)
            if self._wall() >= self._next_heartbeat:
                self._next_heartbeat = self._wall() + _HEARTBEAT_SECONDS
                self._report_health("running")
            if self._clock() >= until:
                return

    def _report_health(self, state: str) -> None:
        latencies, self.latencies = tuple(self.latencies[-100:]), []
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
            latencies=latencies,
            commands=self._command.type,
        )
        self._bus.publish(HEALTH, self._name, message, "robot")
