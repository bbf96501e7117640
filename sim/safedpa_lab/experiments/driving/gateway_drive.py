"""A simulated robot behind the ROS gateway, in one process and in simulated time: messages as ROS sends them, no ROS.

The robot publishes odometry and its goal, the gateway publishes states, the services answer on an in-memory bus, and
the robot's driver holds the last command. Odometry is stamped with the robot's clock and arrives by the gateway's.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from math import isnan
from types import SimpleNamespace
from typing import Any, Final, final

from safedpa.bus import (
    ACTION,
    VERDICT,
    AbstractNode,
    ActionMessage,
    Bus,
    MemoryBroker,
    MemoryTransport,
    ReceivedMessage,
    ServiceLoop,
    StateMessage,
    VerdictMessage,
)
from safedpa.ros.encoding import encode
from safedpa.ros.outgoing import odometry_of
from safedpa_lab.experiments.driving.state_faults import FaultyState
from safedpa_services.ros_gateway.__main__ import load_ros_interface
from safedpa_services.ros_gateway.gateway import Gateway, HealthPublisher
from safedpa_services.ros_gateway.gateway_inputs import SensorInputs
from safedpa_services.ros_gateway.publisher_monitor import CommandEchoMonitor
from safedpa_services.ros_gateway.robot_file import (
    CommandTopic,
    ObstaclesTopic,
    OdometryTopic,
    RobotFile,
    RosConnection,
)
from safedpa_services.ros_gateway.sensor_inputs import LatestMessage, goal_paths, pose_paths
from safedpa_sim.closed_loop import Tick

__all__ = ["drive_by_gateway"]

_ODOMETRY: Final = "nav_msgs/msg/Odometry"
_GOAL: Final = "geometry_msgs/msg/PoseStamped"
_STEP: Final = 0.002
"""s; the services are served this often while the gateway waits."""
_AGE: Final = 0.001
"""s; age of the odometry when the gateway reads it."""


def drive_by_gateway(
    source: FaultyState, robot: str, model: str, settings: str, nodes: Sequence[AbstractNode], ticks: int
) -> Iterator[Tick]:
    """Yields the state and the newest verdict of each of ``ticks`` periods of the gateway.

    ``robot``, ``model`` and ``settings`` are names as in a robot file. A verdict's sentence is the gateway's reason
    while it brakes by itself. Lost states are not sent.
    """
    broker = MemoryBroker()
    first = source.state_message()
    file = RobotFile(
        robot=robot,
        model=model,
        settings=settings,
        odometry=OdometryTopic("/odom"),
        command=CommandTopic("/command"),
        surroundings=ObstaclesTopic(first.field, first.footprint, first.obstacles),
        wire=RosConnection(form="bridge"),
    )
    face, limits, period = load_ros_interface(file)
    side = _RobotSide(source, first, face, face.commands[0])
    with _bus(broker, side) as bus:
        side.loops = [ServiceLoop(node, _bus(broker, side), clock=lambda: side.now) for node in nodes]
        inputs = SensorInputs(side.odometry, CommandEchoMonitor("/command", lambda: side.now), goal=side.goal)
        quiet: Any = SimpleNamespace(form="bridge", watched=lambda *_: [])
        health = HealthPublisher(file.name, "odom", face, None, None, lambda: side.now)
        command: Any = side
        gateway = Gateway(bus, quiet, file, face, limits, inputs, command, health, period, lambda: side.now)
        heard = Bus(MemoryTransport(broker), "gateway").inbox((VERDICT,), file.name)
        verdict: VerdictMessage | None = None
        begin = side.now
        for _ in range(ticks):
            side.advance_to(begin)
            begin = gateway.turn(begin)
            for item in heard.take(0.0):
                if isinstance(item, ReceivedMessage) and isinstance(item.message, VerdictMessage):
                    verdict = item.message
            if verdict is not None:
                shown = replace(verdict, sentence=f"the gateway brakes: {gateway.why}") if gateway.why else verdict
                yield Tick(side.state, shown, None)


def _bus(broker: MemoryBroker, side: _RobotSide) -> _TimedBus:
    bus = _TimedBus(MemoryTransport(broker), "gateway")
    bus.side = side
    return bus


@final
class _RobotSide:
    """The robot with its driver, and the simulated time ``now`` [s]; it is the publisher of the gateway's commands."""

    def __init__(self, source: FaultyState, first: StateMessage, face: Any, command_type: str) -> None:
        self.now, self.type = _AGE + source.arrival(), command_type
        self.state = first
        """As the robot published it."""
        self.loops: list[ServiceLoop] = []
        clock = lambda: self.now  # noqa: E731
        self.odometry = LatestMessage(_ODOMETRY, pose_paths(), "odom", clock)
        self.goal = LatestMessage(_GOAL, goal_paths(), "", clock)
        self._source, self._face = source, face
        self._command: tuple[float, ...] = ()
        self._fields = [path.split(".") for path in face.paths(command_type)]
        self._publish(first)

    def put(self, values: Any) -> None:
        """Takes a command of the gateway."""
        numbers = []
        for path in self._fields:
            found = values
            for name in path:
                found = found.get(name, 0.0) if isinstance(found, dict) else found
            numbers.append(float(found))
        self._command = tuple(numbers)

    def advance_to(self, seconds: float) -> None:
        """Simulates robot and services until then."""
        while self.now < seconds:
            self.now = min(self.now + _STEP, seconds)
            self.serve()

    def serve(self) -> None:
        """Advances the robot by the periods that have passed, and serves each service once."""
        robot = self._source.robot
        while self._source.arrival(1) <= self.now:
            if self._command:
                # The driver has the robot's own speed, whatever its odometry says.
                action = self._face.action(self.type, self._command, robot.values)
                bounds = zip(action, robot.guard.low, robot.guard.high, strict=True)
                values = tuple([max(low, min(high, value)) for value, low, high in bounds])
                at: dict[str, Any] = {"epoch": robot.guard.epoch, "tick": robot.tick, "publish_time": self.now}
                self._source.receive(ActionMessage(**at, robot_time=robot.tick * robot.period, values=values))
            self._source.advance()
            self.state = self._source.state_message()
            self._publish(self.state)
        for loop in self.loops:
            loop.turn(0.0)

    def _publish(self, state: StateMessage) -> None:
        nanoseconds = round(1e9 * (1.0 + state.robot_time))
        stamp = {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9}
        head = {"stamp": stamp, "frame_id": "odom"}
        if not isnan(sum(state.values)):
            self.odometry.take(encode(_ODOMETRY, odometry_of(head, "base", *self._face.planar(state.values))))
        if state.goal:
            place = {"position": {"x": state.goal[0], "y": state.goal[1]}}
            self.goal.take(encode(_GOAL, {"header": head, "pose": place}))


class _TimedBus(Bus):
    """A bus in simulated time: messages are stamped with it, and waiting for them advances it."""

    side: _RobotSide

    def publish(self, topic: Any, robot: str, message: Any, *more: Any, **options: Any) -> None:
        """As ``Bus.publish``, sent at the simulated time."""
        super().publish(topic, robot, replace(message, publish_time=self.side.now), *more, **options)

    def inbox(self, topics: Any, *more: Any, **options: Any) -> Any:
        """As ``Bus.inbox``; those of the gateway advance the simulated time."""
        found = super().inbox(topics, *more, **options)
        return _Waiting(found, self.side) if topics in ((ACTION,), (VERDICT,)) else found


@final
class _Waiting:
    """An inbox of the gateway."""

    def __init__(self, inbox: Any, side: _RobotSide) -> None:
        self._inbox, self._side = inbox, side

    def take(self, longest: float) -> list[Any]:
        """Simulates until a message has arrived, for at most ``longest`` [s]."""
        end = self._side.now + longest
        while not (found := self._inbox.take(0.0)) and self._side.now < end:
            self._side.now = min(self._side.now + _STEP, end)
            self._side.serve()
        return list(found)
