"""The gateway without any network: which actions it sends on, and when it brakes by itself."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, cast

import pytest

from safedpa.bus import ACTION, ActionMessage, Bus, MemoryBroker, MemoryTransport, Received
from safedpa.robots.car.ros_face import CarFace
from safedpa.ros.encoding import encode
from safedpa.ros.graph import Attachment
from safedpa_services.ros_gateway.gateway import Gateway
from safedpa_services.ros_gateway.overheard import Overheard
from safedpa_services.ros_gateway.robot_file import Command, Odometry, RobotFile, Surroundings, Wire, Wish
from safedpa_services.ros_gateway.senses import Newest, Senses
from safedpa_services.ros_gateway.voice import Voice

DRIVE = "ackermann_msgs/msg/AckermannDriveStamped"
ASKED = RobotFile(
    robot="car",
    odometry=Odometry("/odom"),
    wish=Wish("/drive_in"),
    command=Command("/drive", DRIVE),
    surroundings=Surroundings((-4.0, 4.0, -4.0, 4.0), (0.1, 0.4, 0.1)),
    wire=Wire(form="bridge"),
)
LIMITS = ((-0.6, -0.34), (2.0, 0.34), (0.0, 0.0))


class Link:
    form = "bridge"


class Publisher:
    type = DRIVE

    def __init__(self) -> None:
        self.sent: list[tuple[float, float]] = []

    def put(self, values: Mapping[str, Any]) -> None:
        self.sent.append((values["drive"]["speed"], values["drive"]["steering_angle"]))


class Sense:
    refused, why = 0, ""

    def __init__(self, numbers: tuple[float, ...], age: float = 0.0) -> None:
        self.numbers, self.age = numbers, age

    def read(self) -> tuple[tuple[float, ...], float, int]:
        return self.numbers, self.age, 7


class Inbox:
    """Answers with what ``values`` say, for the tick that the gateway is in, after ``seconds``."""

    def __init__(self, gateway: Gateway, now: list[float], values: tuple[float, ...], seconds: float, late: int = 0):
        self.gateway, self.now, self.values, self.seconds, self.late = gateway, now, values, seconds, late

    def take(self, longest: float) -> list[Received]:
        self.now[0] += self.seconds
        message = ActionMessage(
            epoch=self.gateway.epoch,
            tick=self.gateway.tick - self.late,
            robot_time=0.0,
            publish_time=0.0,
            values=self.values,
        )
        return [Received(ACTION, "r1", message, b"", "", self.now[0])]


@pytest.fixture
def parts() -> Iterator[tuple[Gateway, Publisher, list[float], Sense]]:
    now, drive = [100.0], Publisher()
    odometry = Sense((1.0, 2.0, 0.5, 0.0, 0.0, 0.0, 0.0, 1.0))
    with Bus(MemoryTransport(MemoryBroker()), "fleet") as bus:
        command, wish, sense = cast(Any, drive), cast(Any, Sense((0.5, 0.1))), cast(Any, odometry)
        senses = Senses(sense, Overheard("/drive", lambda: now[0]), wish)
        gateway = Gateway(
            bus,
            Link(),
            ASKED,
            CarFace(),
            LIMITS,
            senses,
            command,
            Voice("r1", "odom", CarFace(), None, None),
            0.05,
            lambda: now[0],  # type: ignore[arg-type]
        )
        gateway._verdicts = Quiet(now)  # type: ignore[assignment]
        yield gateway, drive, now, odometry


class Quiet:
    def __init__(self, now: list[float]) -> None:
        self.now = now

    def take(self, longest: float) -> list[Received]:
        self.now[0] += longest + 1e-6
        return []


@pytest.mark.parametrize(
    ("values", "seconds", "late", "wanted"),
    [
        ((0.7, -0.2), 0.01, 0, (0.7, -0.2)),
        ((2.1, 0.0), 0.01, 0, (0.0, 0.0)),  # beyond a limit
        ((float("nan"), 0.0), 0.01, 0, (0.0, 0.0)),
        ((0.7,), 0.01, 0, (0.0, 0.0)),
        ((0.7, -0.2), 0.01, 1, (0.0, 0.0)),  # of the tick before
        ((0.7, -0.2), 1.0, 0, (0.0, 0.0)),  # this process was held up for a second
    ],
)
def test_only_a_fresh_action_of_this_tick_within_the_limits_is_sent(
    parts: tuple[Gateway, Publisher, list[float], Sense],
    values: tuple[float, ...],
    seconds: float,
    late: int,
    wanted: tuple[float, float],
) -> None:
    gateway, drive, now, _ = parts
    gateway._inbox = Inbox(gateway, now, values, seconds, late)  # type: ignore[assignment]
    gateway._turn(now[0])
    assert drive.sent == [wanted]
    assert gateway.watchdog_ticks == int(wanted == (0.0, 0.0))
    assert gateway.tick == 1


def test_an_old_odometry_brakes_before_anybody_is_asked(
    parts: tuple[Gateway, Publisher, list[float], Sense],
) -> None:
    gateway, drive, now, odometry = parts
    odometry.age = 0.11
    gateway._turn(now[0])
    assert drive.sent == [(0.0, 0.0)]
    assert gateway.why == "the odometry is 0.11 s old"


def test_odometry_that_makes_no_pose_brakes_and_says_so(parts: tuple[Gateway, Publisher, list[float], Sense]) -> None:
    gateway, drive, now, odometry = parts
    for numbers in ((1.0, 2.0, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0), (1.0, 2.0, 0.5, 0.0, 1e200, 1e200, 1e200, 1e200)):
        odometry.numbers = numbers
        gateway._turn(now[0])
        assert drive.sent[-1] == (0.0, 0.0)
        assert "no rotation" in gateway.why


def test_it_does_not_say_that_it_drives_before_it_heard_anything(
    parts: tuple[Gateway, Publisher, list[float], Sense],
) -> None:
    assert "not heard its odometry" in parts[0].why


@pytest.mark.parametrize("period", [0.01, 0.05, 1.0])
def test_at_its_end_it_brakes_for_a_second_whatever_its_rate_and_whatever_ended_it(
    parts: tuple[Gateway, Publisher, list[float], Sense], period: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    gateway, drive, _, _ = parts
    slept: list[float] = []
    monkeypatch.setattr("safedpa_services.ros_gateway.gateway.time.sleep", slept.append)
    gateway.period = period

    def broken(begin: float) -> float:
        raise ValueError(begin)

    monkeypatch.setattr(gateway, "_turn", broken)
    with pytest.raises(ValueError, match="100"):
        gateway.run(lambda: False)
    assert set(drive.sent) == {(0.0, 0.0)}
    assert len(drive.sent) == len(slept) >= 10
    assert sum(slept) == pytest.approx(1.0)


def test_of_two_publishers_of_one_topic_neither_is_believed() -> None:
    now, newest = [10.0], Newest("geometry_msgs/msg/Twist", ("linear.x", "angular.z"), clock=lambda: now[0])
    type_name = "geometry_msgs/msg/Twist"

    def heard(sender: bytes, seconds: float) -> float:
        now[0] += seconds
        vectors = {"linear": {"x": 0.5, "y": 0.0, "z": 0.0}, "angular": {"x": 0.0, "y": 0.0, "z": 0.1}}
        newest.take(encode(type_name, vectors), Attachment(1, 0, sender))
        return newest.read()[1]

    one, other = b"1" * 16, b"2" * 16
    assert [heard(one, 0.05) for _ in range(3)] == [0.0] * 3
    assert heard(other, 0.05) == float("inf")
    assert heard(one, 0.05) == float("inf")
    assert "two publishers" in newest.why
    assert heard(one, 1.1) == 0.0, "the other one is gone"
    assert newest.why == ""
    assert heard(other, 2.0) == 0.0, "one that was started anew, after the first had ended"
