"""Further inputs of the gateway: scans, goals, localisation, and other publishers."""

import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as some
from tests.messages import verdict_of
from tests.ros.gateway_rig import ASKED, rig_of

from safedpa.bus import ScanMessage, StateMessage
from safedpa.errors import InputError
from safedpa.robots.car.adapters.ros import CarFace
from safedpa.robots.differential_drive.ros_face import DifferentialDriveFace
from safedpa.ros.encoding import encode
from safedpa.ros.graph import Attachment
from safedpa.ros.outgoing import odometry_of, transform_of
from safedpa_services.ros_gateway.gateway import HealthPublisher
from safedpa_services.ros_gateway.gateway_inputs import SensorInputs
from safedpa_services.ros_gateway.publisher_monitor import CommandEchoMonitor
from safedpa_services.ros_gateway.robot_file import (
    LocalisationTopic,
    ObstaclesTopic,
    RobotFile,
    ScanTopic,
    load_robot_file,
)
from safedpa_services.ros_gateway.sensor_inputs import (
    TRANSFORMS,
    LatestMessage,
    PoseAndTwist,
    TransformListener,
    goal_paths,
    pose_paths,
)
from safedpa_services.ros_gateway.sensor_tables import LASER, FrameTopics, SourceTopic
from safedpa_services.ros_gateway.sources import BodyFrames, SourceReader, SourceReceiver

INFINITE, NONE = math.inf, math.nan


def scanner_of(frame: str = "", clock: Callable[[], float] = time.monotonic, ahead: float = 0.0) -> SourceReceiver:
    topic = SourceTopic("/scan", frame=frame, mount=(ahead, 0.0, 0.0))
    return SourceReceiver(SourceReader(topic, (), BodyFrames(FrameTopics(), 0.0, lambda _: None, clock)), clock)


def scan_of(ranges: list[float], **changes: Any) -> bytes:
    fields = {
        "header": {"stamp": {"sec": 1, "nanosec": 1}, "frame_id": changes.pop("frame", "laser")},
        "angle_min": -1.5, "angle_max": 1.5, "angle_increment": 0.5, "range_min": 0.1, "range_max": 12.0,
        "ranges": ranges,
    }  # fmt: skip
    return encode(LASER, {**fields, **changes})


def test_rays_of_a_scan_are_taken_as_measured_and_missing_ones_stay_missing() -> None:
    scanner = scanner_of("laser", clock=lambda: 7.0)
    scanner.take(scan_of([2.0, INFINITE, -INFINITE, NONE, 0.0, 0.05, 13.0]))
    (turn,) = scanner.take_all()
    assert turn.rays.ranges == (2.0, 12.0, pytest.approx(0.1), -1.0, -1.0, -1.0, 12.0)
    assert (turn.arrived, turn.rays.first_angle, turn.rays.angle_step, turn.rays.farthest) == (7.0, -1.5, 0.5, 12.0)
    assert scanner.take_all() == []
    scanner.take(scan_of([2.0] * 7))
    assert scanner.take_all() == [], "the same stamp again is no news"


@pytest.mark.parametrize(
    "changes",
    [
        {"angle_increment": 0.0}, {"angle_min": NONE}, {"range_max": INFINITE}, {"range_min": 20.0},
        {"range_min": -1.0}, {"ranges": []}, {"angle_increment": 3.0}, {"frame": "camera"},
    ],
)  # fmt: skip
def test_an_invalid_scan_is_refused_and_counted(changes: dict[str, Any]) -> None:
    scanner = scanner_of("laser")
    scanner.take(scan_of([1.0] * 7, **changes) if "ranges" not in changes else scan_of(**changes))
    assert scanner.take_all() == []
    assert scanner.refused == 1
    assert scanner.why


@settings(max_examples=200, deadline=None)
@given(some.data())
def test_mutated_messages_raise_nothing(data: some.DataObject) -> None:
    head = {"stamp": {"sec": 1, "nanosec": 5}, "frame_id": "map"}
    whole = {
        LASER: scan_of([1.0] * 7),
        TRANSFORMS: encode(TRANSFORMS, {"transforms": [transform_of(head, "odom", 1.0, 2.0, 0.3)]}),
    }
    name = data.draw(some.sampled_from(sorted(whole)))
    message = bytearray(whole[name])
    for _ in range(data.draw(some.integers(1, 6))):
        message[data.draw(some.integers(0, len(message) - 1))] = data.draw(some.integers(0, 255))
    cut = data.draw(some.integers(0, len(message)))
    scanner, localised = scanner_of(), TransformListener("map", "odom")
    for sense in (scanner, localised):
        sense.take(bytes(message[:cut]) if data.draw(some.booleans()) else bytes(message))
    for turn in scanner.take_all():
        assert all(-1.0 <= one <= turn.rays.farthest for one in turn.rays.ranges)
    assert all(map(math.isfinite, localised.read()[0]))


def test_the_pose_is_moved_into_the_map_by_the_newest_transform_of_those_two_frames() -> None:
    now = [5.0]
    localised = TransformListener("map", "/odom", clock=lambda: now[0])
    assert localised.read()[1] == INFINITE

    def reported(frame: str, child: str, x: float, yaw: float) -> None:
        head = {"stamp": {"sec": 1, "nanosec": 5}, "frame_id": frame}
        localised.take(encode(TRANSFORMS, {"transforms": [transform_of(head, child, x, 2.0, yaw)]}))

    reported("odom", "base_link", 9.0, 0.0)
    assert localised.read()[1] == INFINITE
    reported("map", "odom", 1.0, math.pi / 2)
    now[0] = 5.5
    frame, age = localised.read()
    assert age == 0.5
    moved = PoseAndTwist(1.0, 0.0, 0.25, 0.7, 0.1).seen_from(frame)
    assert (moved.x, moved.y, moved.yaw) == (pytest.approx(1.0), pytest.approx(3.0), pytest.approx(0.25 + math.pi / 2))
    reported("map", "odom", NONE, 0.0)
    assert localised.read() == (frame, 0.5)
    assert localised.refused == 1


def test_a_publisher_without_a_token_on_the_driver_s_topic_is_reported_and_answered() -> None:
    now, answers = [1.0], [0]
    heard = CommandEchoMonitor("/drive", clock=lambda: now[0])

    def answer() -> None:
        answers[0] += 1

    heard.answer = answer
    assert heard.why == ""
    heard.take(b"", Attachment(1, 2, b"\xab" * 16))
    assert heard.why == "an unannounced publisher (sender abababab) sends on /drive, too; find and end it"
    for _ in range(1000):
        heard.take(b"")
    assert answers == [1], "a flood is answered once in a millisecond"
    assert "unknown sender" in heard.why
    now[0] += 0.0005
    heard.take(b"")
    assert answers == [1]
    now[0] += 0.001
    heard.take(b"")
    assert answers == [2]
    now[0] += 0.99
    assert heard.why
    now[0] += 0.02
    assert heard.why == ""


def signed(sender: bytes) -> Attachment:
    return Attachment(1, 2, sender * 16)


def odometry_at(x: float, nanoseconds: int) -> bytes:
    head = {"stamp": {"sec": 1, "nanosec": nanoseconds}, "frame_id": "odom"}
    return encode("nav_msgs/msg/Odometry", odometry_of(head, "base_link", x, 0.0, 0.0, 0.0, 0.0))


def transform_at(x: float, nanoseconds: int) -> bytes:
    head = {"stamp": {"sec": 1, "nanosec": nanoseconds}, "frame_id": "map"}
    return encode(TRANSFORMS, {"transforms": [transform_of(head, "odom", x, 0.0, 0.0)]})


def test_messages_of_two_publishers_are_refused_even_if_one_has_no_attachment() -> None:
    now = [5.0]
    clock = lambda: now[0]  # noqa: E731
    odometry = LatestMessage("nav_msgs/msg/Odometry", pose_paths(), "odom", clock)
    localised, scanner = TransformListener("map", "odom", clock), scanner_of("laser", clock)
    for turn, alongside in enumerate((signed(b"a"), None, signed(b"a"), None)):
        odometry.take(odometry_at(float(turn), turn), alongside)
        now[0] += 0.02
    assert odometry.read()[1] == INFINITE
    for turn, sender in enumerate((b"a", b"b", b"a")):
        localised.take(transform_at(float(turn), turn), signed(sender))
        scanner.take(scan_of([1.0 + turn] * 7, header=_head(turn)), signed(sender))
        now[0] += 0.02
    assert localised.read()[1] == INFINITE
    assert "two publishers" in localised.why
    assert "two publishers" in scanner.why
    assert [turn.rays.ranges[0] for turn in scanner.take_all()] == [1.0]
    now[0] += 1.01
    odometry.take(odometry_at(7.0, 9), signed(b"a"))
    localised.take(transform_at(7.0, 9), signed(b"a"))
    assert (odometry.read()[1], localised.read()) == (0.0, ((7.0, 0.0, 0.0), 0.0))


def _head(nanoseconds: int) -> dict[str, Any]:
    return {"stamp": {"sec": 1, "nanosec": nanoseconds}, "frame_id": "laser"}


def test_transforms_of_other_frames_are_ignored_and_repeated_ones_age() -> None:
    now = [5.0]
    localised = TransformListener("map", "odom", lambda: now[0])
    head = {"stamp": {"sec": 1, "nanosec": 5}, "frame_id": "odom"}
    other = encode(TRANSFORMS, {"transforms": [transform_of(head, "base_link", 9.0, 0.0, 0.0)]})
    for _ in range(3):
        localised.take(other, signed(b"o"))
        localised.take(transform_at(1.0, 5), signed(b"a"))
        now[0] += 0.5
    assert localised.read() == ((1.0, 0.0, 0.0), 1.5)


def test_a_number_that_the_bus_would_refuse_is_refused_on_arrival() -> None:
    odometry = LatestMessage("nav_msgs/msg/Odometry", pose_paths(), "odom")
    odometry.take(odometry_at(1e13, 1))
    goal = LatestMessage("geometry_msgs/msg/PoseStamped", goal_paths(), "")
    goal.take(encode("geometry_msgs/msg/PoseStamped", {"pose": {"position": {"x": 1e300}}}))
    localised, scanner = TransformListener("map", "odom"), scanner_of("laser")
    localised.take(transform_at(-1e15, 1))
    scanner.take(scan_of([1.0] * 7, angle_min=1e30))
    assert [one.refused for one in (odometry, goal, localised, scanner)] == [1, 1, 1, 1]
    sensor_inputs = SensorInputs(odometry, CommandEchoMonitor("/drive"), None, goal, localised, sources=(scanner,))
    assert sorted(sensor_inputs.refusals(["laser"])) == ["goal_refused", "laser_refused"]


class Markers:
    type = "visualization_msgs/msg/MarkerArray"

    def __init__(self) -> None:
        self.notice: list[Any] = []

    def put(self, values: Any) -> None:
        self.notice.append(values)


def test_a_path_of_another_model_is_ignored() -> None:
    markers: Any = Markers()
    now = [7.0]
    health_publisher = HealthPublisher("r1", "odom", DifferentialDriveFace(), None, markers, clock=lambda: now[0])
    verdict = verdict_of("passed", predicted=((0.0, 0.0, 0.0, 1.0),))
    health_publisher.verdict(verdict)
    assert markers.notice == []
    now[0] += 1.0
    health_publisher.verdict(replace(verdict, predicted=((0.5, 0.0, 0.0, 1.0, 0.0),)))
    assert markers.notice[0]["markers"][0]["points"] == [{"x": 0.5, "y": 0.0}]


def test_a_path_is_published_at_most_ten_times_a_second_and_not_without_a_prediction() -> None:
    markers: Any = Markers()
    now = [7.0]
    health_publisher = HealthPublisher("r1", "odom", DifferentialDriveFace(), None, markers, clock=lambda: now[0])
    verdict = verdict_of("passed", predicted=((0.5, 0.0, 0.0, 1.0, 0.0),))
    for hundredth in range(100):
        now[0] = 7.0 + 0.01 * hundredth
        health_publisher.verdict(replace(verdict, predicted=()) if hundredth < 50 else verdict)
    assert 5 <= len(markers.notice) <= 6
    assert all(notice["markers"][0]["points"] for notice in markers.notice)
    HealthPublisher("r1", "odom", DifferentialDriveFace(), None, None, clock=lambda: 7.0).verdict(verdict)


class Diagnostics:
    type = "diagnostic_msgs/msg/DiagnosticArray"

    def __init__(self) -> None:
        self.notice: list[Any] = []

    def put(self, values: Any) -> None:
        self.notice.append(values["status"][0])


def test_a_state_has_the_goal_and_pose_in_the_map_and_diagnostics_say_why_the_gateway_brakes() -> None:
    now = [100.0]
    file = RobotFile(
        robot="car", odometry=ASKED.odometry, command=ASKED.command, wire=ASKED.wire,
        surroundings=ObstaclesTopic((-4.0, 4.0, -4.0, 4.0), (0.1, 0.4, 0.1)),
        localisation=LocalisationTopic("/tf"), scans=(ScanTopic("/scan", mount=(0.2, 0.0, 0.0), delay=0.02),),
    )  # fmt: skip
    clock = lambda: now[0]  # noqa: E731
    odometry = LatestMessage("nav_msgs/msg/Odometry", pose_paths(), "odom", clock)
    goal = LatestMessage("geometry_msgs/msg/PoseStamped", goal_paths(), "map", clock)
    localised, scanner, diagnostics = TransformListener("map", "odom", clock), scanner_of("", clock, 0.2), Diagnostics()
    shown: Any = diagnostics
    health_publisher = HealthPublisher("r1", file.frame, CarFace(), shown, None, clock)
    sensor_inputs = {"goal": goal, "localised": localised, "sources": (scanner,)}
    with rig_of(asked=file, health_publisher=health_publisher, now=now, odometry=odometry, **sensor_inputs) as rig:

        def turn(nanoseconds: int) -> None:
            head = {"stamp": {"sec": 5, "nanosec": nanoseconds}, "frame_id": "odom"}
            odometry.take(encode("nav_msgs/msg/Odometry", odometry_of(head, "b", 1.0, 0.0, 0.0, 0.5, 0.0)))
            rig.turns()

        turn(1)
        assert diagnostics.notice[-1]["message"] == "the gateway brakes: the transform from map to odom is missing"
        head = {"stamp": {"sec": 1, "nanosec": 5}, "frame_id": "map"}
        localised.take(encode(TRANSFORMS, {"transforms": [transform_of(head, "odom", 0.0, 2.0, 0.0)]}))
        pose = {"position": {"x": 3.0, "y": -1.0}}
        goal.take(encode("geometry_msgs/msg/PoseStamped", {"header": head, "pose": pose}))
        scanner.take(scan_of([2.0] * 7))
        turn(2)
        messages = rig.messages()
    (state,) = [message for message in messages if isinstance(message, StateMessage)]
    (scan,) = [message for message in messages if isinstance(message, ScanMessage)]
    assert (state.values, state.goal, state.sources) == ((1.0, 2.0, 0.0, 0.5), (3.0, -1.0), ("laser",))
    assert (scan.source, scan.mount, scan.number) == ("laser", (0.2, 0.0, 0.0), 1)
    assert scan.robot_time == pytest.approx(0.05 - 0.02)
    assert diagnostics.notice[-1]["message"] == "the gateway brakes: no action of the filter arrived in time"
    facts = {pair["key"]: pair["value"] for pair in diagnostics.notice[-1]["values"]}
    assert facts["odometry_stamp"] == str(5 * 10**9 + 2)


@pytest.mark.parametrize(("sent", "retained"), [(1, 1), (8, 8), (9, 8), (40, 8)])
def test_of_the_scans_between_two_periods_the_newest_eight_are_kept(sent: int, retained: int) -> None:
    scanner = scanner_of("laser")
    for number in range(sent):
        scanner.take(scan_of([1.0 + number / 100.0] * 7, header=_head(number + 1)))
    newest = [1.0 + number / 100.0 for number in range(sent)][-retained:]
    assert [turn.rays.ranges[0] for turn in scanner.take_all()] == pytest.approx(newest)


def test_scans_without_a_stamp_are_all_new() -> None:
    scanner = scanner_of("laser")
    for _ in range(3):
        scanner.take(scan_of([1.0] * 7, header={"stamp": {"sec": 0, "nanosec": 0}, "frame_id": "laser"}))
    assert len(scanner.take_all()) == 3


@pytest.mark.parametrize(
    ("rays", "changes", "believed"),
    [
        (8192, {"angle_min": 0.0, "angle_increment": 2.0 * math.pi / 8192}, True),
        (8193, {"angle_min": 0.0, "angle_increment": 2.0 * math.pi / 8193}, False),
        (5, {"angle_min": 0.0, "angle_increment": math.pi / 2.0}, True),  # the first direction again at the end
        (7, {"angle_min": 0.0, "angle_increment": math.pi / 2.0}, False),
        (5, {"angle_min": 0.0, "angle_increment": -math.pi / 2.0}, True),
        (7, {"angle_min": 0.0, "angle_increment": -math.pi / 2.0}, False),
        (4, {"angle_min": 12.5, "angle_increment": 0.1}, True),
        (4, {"angle_min": -12.5, "angle_increment": 0.1}, True),
        (4, {"angle_min": 12.6, "angle_increment": 0.1}, False),
        (4, {"angle_min": -12.6, "angle_increment": 0.1}, False),
        (7, {"range_min": 0.0, "range_max": 1000.0}, True),
        (7, {"range_min": 0.1, "range_max": 1001.0}, False),
        (7, {"range_min": 2.0, "range_max": 2.0}, False),
    ],
)
def test_a_scan_has_a_turn_and_8192_rays_at_most_and_reaches_a_kilometre_at_most(rays, changes, believed):
    scanner = scanner_of("laser")
    scanner.take(scan_of([1.0] * rays, **changes))
    assert (len(scanner.take_all()), scanner.refused) == (believed, not believed)


WHOLE = (
    'format = 2\nrobot = "car"\n[odometry]\ntopic = "/odom"\n[nominal]\ntopic = "/drive_in"\n[command]\n'
    'topic = "/drive"\n[surroundings]\nfield = [-4, 4, -4, 4]\nfootprint = [0.08, 0.4, 0.12]\n'
)


@pytest.mark.parametrize(
    ("before", "after", "notice"),
    [
        ('"car"', '"carr"', "robot 'carr': did you mean 'car'"),
        ('robot = "car"\n', 'robot = "car"\nname = "a/b"\n', "name: 'a/b': it is empty or contains one of / * $"),
        (
            "[-4, 4, -4, 4]",
            "[4, -4, -4, 4]",
            "surroundings.field: got [4.0, -4.0, -4.0, 4.0], wanted lowest x",
        ),
        ("[-4, 4, -4, 4]", "[0, 0.2, -4, 4]", "room for a robot of 0.24 m width"),
        ("[-4, 4, -4, 4]", "[-1e9, 4, -4, 4]", "surroundings.field: got [-1000000000.0"),
        ("0.12]", "0.0]", "surroundings.footprint: got [0.08, 0.4, 0.0], wanted the extents behind"),
        ("[0.08, 0.4", "[-0.5, 0.4", "surroundings.footprint: got [-0.5, 0.4, 0.12]"),
        ('"/odom"', '"/od om"', "odometry.topic: got '/od om', wanted a topic such as /odom"),
        ('"/drive_in"', '"/drive/*"', "nominal.topic: got '/drive/*'"),
        ('"/odom"', '"/odom"\ntype = "nav_msgs/msg/Path"', "odometry.type: got 'nav_msgs/msg/Path', wanted nav_msgs"),
        ('"/drive"', '"/drive"\nhash = "x"', "command.hash: got 'x', wanted RIHS01_ and 64 hex digits"),
        (
            "[surr",
            '[wire]\nendpoint = "robot"\n[surr',
            "wire.endpoint: got 'robot', wanted an endpoint such as tcp/robot:7447",
        ),
        ("[surr", '[[scans]]\ntopic = "/scan"\nmount = [1, 2]\n[surr', "scans.mount: got [1.0, 2.0], wanted x ahead"),
        ("[surr", '[scans]\ntopic = "/scan"\n[surr', "scans: got {'topic': '/scan'}, wanted tables [[scans]]"),
        ("0.12]", "0.12]\ngoal = [9, 9]", "surroundings.goal: got [9.0, 9.0], wanted x and y within the field"),
        (
            "0.12]",
            '0.12]\nobstacles = [[0, 0, 1]]\n[[scans]]\ntopic = "/scan"',
            "surroundings.obstacles: got some",
        ),
        ("[surr", '[wire]\ndiagnostics = "drive"\n[surr', "wire.diagnostics: got 'drive', the topic of the command"),
        (
            "[surr",
            '[wire]\nform = "bridge"\nmarkers = "drive"\n[surr',
            "wire.markers: got 'drive', the topic of the command",
        ),
        ('"/drive_in"', '"/drive"', "nominal.topic: got '/drive', the topic of the command"),
        ('"/drive_in"', '"drive"', "nominal.topic: got '/drive', the topic of the command"),
        ("[surr", '[wire]\nmarkers = "/a/**"\n[surr', "wire.markers: got '/a/**', wanted a topic such as /odom"),
        (
            "[surr",
            '[localisation]\ntopic = "/tf"\nframe = "odom"\n[surr',
            "localisation.frame: got 'odom', wanted the map",
        ),
        ("0.12]", "0.12]\nobstacles = [[0, 0, -1]]", "surroundings.obstacles: wanted x, y and a radius above 0"),
    ],
)
def test_an_impossible_robot_file_is_refused_in_one_line_that_names_the_key(tmp_path, before, after, notice):
    path = tmp_path / "robot.toml"
    path.write_text(WHOLE)
    assert load_robot_file(path).name == "r1"
    path.write_text(WHOLE.replace(before, after, 1))
    with pytest.raises(InputError) as caught:
        load_robot_file(path)
    assert notice in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("rate", "brakes"), [(1.0, False), (3.0, True), (0.3, True)])
def test_odometry_whose_stamps_advance_at_another_rate_than_the_clock_brakes_the_robot(
    rate: float, brakes: bool
) -> None:
    now = [100.0]
    odometry = LatestMessage("nav_msgs/msg/Odometry", pose_paths(), "odom", lambda: now[0])
    with rig_of(now=now, odometry=odometry) as rig:
        rig.act(0.5, 0.1)

        def measured(turn: int) -> None:
            head = {"stamp": {"sec": 7, "nanosec": 0}, "frame_id": "odom"}
            stamp = round(1e9 * 0.05 * rate * turn)
            head["stamp"] = {"sec": 7 + stamp // 10**9, "nanosec": stamp % 10**9}
            odometry.take(encode("nav_msgs/msg/Odometry", odometry_of(head, "b", 0.0, 0.0, 0.0, 0.0, 0.0)))

        sent = rig.turns(30, measured)
    assert sent[1] == (0.5, 0.1)
    assert (sent[-1] == (0.0, 0.0)) is brakes
    assert ("its stamps advance" in rig.gateway.why) is brakes
