"""A gateway without a network: the test sets its clock, its inputs and the filter's actions."""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any
from unittest.mock import patch

from safedpa.bus import (
    ACTION,
    HEALTH,
    NOMINAL,
    SCAN,
    STATE,
    ActionMessage,
    Bus,
    MemoryBroker,
    MemoryTransport,
    ReceivedMessage,
    Topic,
)
from safedpa.robots.car.adapters.ros import CarFace
from safedpa_services.ros_gateway.gateway import Gateway, HealthPublisher
from safedpa_services.ros_gateway.gateway_inputs import SensorInputs
from safedpa_services.ros_gateway.publisher_monitor import CommandEchoMonitor
from safedpa_services.ros_gateway.robot_file import (
    CommandTopic,
    NominalActionTopic,
    ObstaclesTopic,
    OdometryTopic,
    RobotFile,
    RosConnection,
)

DRIVE = "ackermann_msgs/msg/AckermannDriveStamped"
ASKED = RobotFile(
    robot="car",
    odometry=OdometryTopic("/odom"),
    nominal=NominalActionTopic("/drive_in"),
    command=CommandTopic("/drive", DRIVE),
    surroundings=ObstaclesTopic((-4.0, 4.0, -4.0, 4.0), (0.1, 0.4, 0.1)),
    wire=RosConnection(form="bridge"),
)
LIMITS = ((-0.6, -0.34), (2.0, 0.34), (0.0, 0.0))
POSE = (1.0, 2.0, 0.5, 0.0, 0.0, 0.0, 0.0, 1.0)
"""Numbers of the odometry; the last four are the rotation."""


class Link:
    """A link with given other publishers."""

    def __init__(self, form: str = "bridge", *others: Any) -> None:
        self.form, self.others = form, list(others)

    def watched(self, topic: str, *_: Any) -> list[Any]:
        return [one for one in self.others if one.topic == topic]


class Publisher:
    """Stores the commands to the robot: speed and steering angle."""

    type = DRIVE

    def __init__(self) -> None:
        self.sent: list[tuple[float, float]] = []

    def put(self, values: Mapping[str, Any]) -> None:
        self.sent.append((values["drive"]["speed"], values["drive"]["steering_angle"]))


class Sense:
    """Numbers with an age [s]."""

    refused, why, clock, lag, type = 0, "", "", 0.0, ""

    def __init__(self, numbers: tuple[float, ...], age: float = 0.0) -> None:
        self.numbers, self.age = numbers, age

    def read(self) -> tuple[Any, float, int]:
        return self.numbers, self.age, 7


@dataclass
class Rig:
    """A gateway with its parts and its outputs."""

    now: list[float]
    drive: Publisher
    odometry: Sense
    driver: CommandEchoMonitor
    gateway: Gateway = field(init=False)
    heard: Any = field(init=False)
    answer: Callable[[], list[ReceivedMessage]] | None = None
    """What the filter sends when it is waited for; it advances the clock."""
    answers_after: float = 0.0

    def act(self, *values: float, seconds: float = 0.01, held_up: float = 0.0, **changes: Any) -> None:
        """The filter answers each state after ``seconds``; the process is then suspended for ``held_up``."""

        def answer() -> list[ReceivedMessage]:
            self.now[0] += seconds + held_up
            stamp = {"epoch": self.gateway.epoch, "tick": self.gateway.tick}
            message = ActionMessage(**{**stamp, "robot_time": 0.0, "publish_time": 0.0, "values": values, **changes})
            return [ReceivedMessage(ACTION, "r1", message, b"", "", self.now[0])]

        self.answer, self.answers_after = answer, seconds

    def turns(self, count: int = 1, before: Callable[[int], None] = lambda _: None) -> list[tuple[float, float]]:
        """Returns the commands of a number of periods, without the final braking; ``before`` is called before each."""
        done, first, marks = -1, len(self.drive.sent), [0]

        def stopped() -> bool:
            nonlocal done
            done += 1
            marks[0] = len(self.drive.sent)
            if done < count:
                before(done)
            return done >= count

        with patch.object(time, "sleep"):
            self.gateway.run(stopped)
        return self.drive.sent[first : marks[0]]

    def messages(self) -> list[Any]:
        """Returns the messages on the bus since the last call."""
        return [item.message for item in self.heard.take(0.0) if isinstance(item, ReceivedMessage)]


class Waiting:
    """An empty inbox; waiting advances the clock."""

    dropped = 0

    def __init__(self, rig: Rig, topic: Topic) -> None:
        self.rig, self.acts = rig, topic is ACTION

    def take(self, longest: float) -> list[ReceivedMessage]:
        if self.acts and self.rig.answer is not None and self.rig.answers_after < longest:
            return self.rig.answer()
        self.rig.now[0] += longest + 1e-6 if longest > 0.0 else 0.0
        return []


class SteppedBus(Bus):
    """A bus whose inboxes use the test's clock."""

    rig: Rig

    def inbox(self, topics: tuple[Topic, ...], *_: Any, **__: Any) -> Any:
        return Waiting(self.rig, topics[0])


@contextmanager
def rig_of(
    *,
    asked: RobotFile = ASKED,
    link: Any = None,
    health_publisher: Any = None,
    now: list[float] | None = None,
    odometry: Any = None,
    driver: Any = None,
    zone_state: Any = None,
    **sensor_inputs: Any,
) -> Iterator[Rig]:
    """Yields a gateway at 20 Hz from 100 s on; ``sensor_inputs`` are the fields of ``SensorInputs``."""
    clock, broker = now or [100.0], MemoryBroker()
    rig = Rig(clock, Publisher(), odometry or Sense(POSE), driver or CommandEchoMonitor("/drive", lambda: clock[0]))
    with SteppedBus(MemoryTransport(broker), "fleet") as bus, Bus(MemoryTransport(broker), "fleet") as ear:
        bus.rig = rig
        rig.heard = ear.inbox((STATE, SCAN, NOMINAL, HEALTH), "r1", keep_all=True)
        known = SensorInputs(rig.odometry, rig.driver, **{"nominal": None, **sensor_inputs})  # type: ignore[arg-type]
        notice = health_publisher or HealthPublisher("r1", "odom", CarFace(), None, None)
        made: Any = (link or Link(), asked, CarFace(), LIMITS, known, rig.drive, notice, 0.05, lambda: clock[0])
        rig.gateway = Gateway(bus, *made, zone_state=zone_state)
        yield rig
