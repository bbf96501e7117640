"""A declared localisation confirms an implausible state: only a pose that agrees, and no order of a person."""

import time
from math import cos, sin
from pathlib import Path
from typing import Any

import pytest

from safedpa.bus import Bus, MemoryBroker, MemoryTransport, Request
from safedpa.bus.messages.requests import CONFIRM, ORDER
from safedpa.errors import InputError
from safedpa.ros.encoding import encode
from safedpa.runtime.stop_orders import StopOrders
from safedpa_services.ros_gateway.pose_confirmation import CONFIRMED_POSE, PoseConfirmation
from safedpa_services.ros_gateway.robot_file import ConfirmationTopic, load_robot_file
from safedpa_services.ros_gateway.sensor_inputs import PoseAndTwist

HERE = PoseAndTwist(1.0, 2.0, 0.5, 0.0, 0.0)


def pose_of(x: float, y: float, yaw: float, frame: str = "map", *, nanosecond: int = 1) -> bytes:
    turn = {"x": 0.0, "y": 0.0, "z": sin(yaw / 2.0), "w": cos(yaw / 2.0)}
    header = {"stamp": {"sec": 1, "nanosec": nanosecond}, "frame_id": frame}
    pose = {"position": {"x": x, "y": y, "z": 0.0}, "orientation": turn}
    return encode(CONFIRMED_POSE, {"header": header, "pose": {"pose": pose, "covariance": [0.0] * 36}})


def wait_until(is_true: Any, seconds: float = 5.0) -> bool:
    end = time.monotonic() + seconds
    while not is_true() and time.monotonic() < end:
        time.sleep(0.01)
    return bool(is_true())


@pytest.mark.parametrize(
    ("sent", "confirmed"),
    [
        ((1.1, 2.1, 0.4), True),
        ((1.1, 2.1, 0.4 + 6.283185), True),
        ((1.8, 2.0, 0.5), False),
        ((1.0, 2.0, 1.5), False),
        ((1.0, 2.0, 0.5, "odom"), False),
        (None, False),
    ],
)
def test_a_pose_that_agrees_with_the_state_confirms_it(sent: Any, confirmed: bool) -> None:
    broker, orders = MemoryBroker(), StopOrders()
    orders.latch("r1", "it jumped by 0.8 m")
    with Bus(MemoryTransport(broker), "fleet") as gateway, Bus(MemoryTransport(broker), "fleet") as filtering:
        filtering.answer_requests(orders.answer, kinds=(ORDER, CONFIRM))
        confirmation = PoseConfirmation(gateway, "r1", ConfirmationTopic("/initialpose"), "map")
        confirmation.check(HERE)
        if sent is not None:
            confirmation.input.take(pose_of(*sent))
        confirmation.check(HERE)
        assert wait_until(lambda: not orders.reason("r1"), 5.0 if confirmed else 0.2) is confirmed


def test_each_pose_counts_once_and_only_if_it_came_since_the_state_became_implausible() -> None:
    now, asked, broker = [10.0], list[str](), MemoryBroker()
    orders = StopOrders()

    def answer(robot: str, request: Request) -> Any:
        asked.append(request.do)
        return orders.answer(robot, request)

    with Bus(MemoryTransport(broker), "fleet") as gateway, Bus(MemoryTransport(broker), "fleet") as filtering:
        filtering.answer_requests(answer, kinds=(ORDER, CONFIRM))
        confirmation = PoseConfirmation(gateway, "r1", ConfirmationTopic("/initialpose"), "map", lambda: now[0])

        def checked(seconds: float) -> None:
            for _ in range(round(10 * seconds)):
                now[0] += 0.1
                confirmation.check(HERE)

        confirmation.input.take(pose_of(1.0, 2.0, 0.5))
        checked(2.0)
        time.sleep(0.1)
        assert asked == [], "it is from before"
        for nanosecond in range(2, 6):
            confirmation.input.take(pose_of(1.0, 2.0, 0.5, nanosecond=nanosecond))
            checked(2.0)
        assert wait_until(lambda: bool(asked))
        assert asked == ["confirm"], "a frozen pose with new stamps is the same pose"
        confirmation.input.take(pose_of(1.01, 2.0, 0.5, nanosecond=9))
        checked(2.0)
        assert wait_until(lambda: len(asked) == 2)


def test_nothing_but_a_confirmation_is_answered_under_its_key() -> None:
    broker, orders = MemoryBroker(), StopOrders()
    orders.answer("r1", Request(do="stop", who="ann"))
    with Bus(MemoryTransport(broker), "fleet") as robot, Bus(MemoryTransport(broker), "fleet") as filtering:
        filtering.answer_requests(orders.answer, kinds=(ORDER, CONFIRM))
        for do in ("go", "stop", "status", "confirm"):
            answer = robot.request("r1", Request(do=do, who="r1"), 1.0, CONFIRM)
            assert answer is not None
            assert not answer.ok
    assert orders.reason("r1") == "ordered by ann"


def test_wrong_limits_are_refused(tmp_path: Path) -> None:
    text = (Path(__file__).parents[2] / "docs" / "examples" / "turtlebot.toml").read_text()
    for key, value in (("distance", 0.0), ("distance", 2.0), ("angle", -1.0), ("topic", '"a b"')):
        path = tmp_path / "robot.toml"
        path.write_text(f"{text}\n[confirmation]\n{key} = {value}\n")
        with pytest.raises(InputError, match=f"confirmation.{key}"):
            load_robot_file(path)
