"""Encoding, byte for byte: published hashes, attachments, tokens, messages that other libraries read."""

import shutil
import struct
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from rosbags.typesys import Stores, get_typestore
from zenoh_ros2_sdk.attachment import Attachment as TheirAttachment

from safedpa.errors import InputError
from safedpa.robots.car.adapters.ros import CarFace, ThrottleCarFace
from safedpa.ros.decoding import Decoder
from safedpa.ros.definitions import Definitions
from safedpa.ros.encoding import encode, hash_of
from safedpa.ros.graph import NO_HASH, Attachment, Endpoint, data_key, node_token
from safedpa.ros.outgoing import odometry_of, transform_of
from safedpa_services.ros_gateway.__main__ import load_ros_interface
from safedpa_services.ros_gateway.robot_file import load_robot_file
from safedpa_services.ros_gateway.sensor_inputs import LatestMessage, PoseAndTwist, pose_paths

GOLDEN = {
    "ackermann_msgs/msg/AckermannDriveStamped": "48ca7612a08d3bb72744fd98b71b7cf2ea24c6ad50fa4e1aa0bbad963c90d8cf",
    "std_msgs/msg/String": "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
    "sensor_msgs/msg/Image": "d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47",
}
"""Published: CARLA's golden test, ROS 2's own tests."""

WHOLE = (
    'format = 2\nrobot = "car"\n[odometry]\ntopic = "/odom"\n[nominal]\ntopic = "/drive_in"\n'
    '[command]\ntopic = "/drive"\n'
    "[surroundings]\nfield = [-4, 4, -4, 4]\nfootprint = [0.08, 0.4, 0.12]\n"
)


@pytest.mark.parametrize("name", GOLDEN)
def test_hashes_are_the_published_ones(name: str) -> None:
    assert hash_of(name) == f"RIHS01_{GOLDEN[name]}"


def test_keys_tokens_and_attachments_are_those_of_rmw_zenoh() -> None:
    string = data_key(0, "/chatter", "std_msgs/msg/String", hash_of("std_msgs/msg/String"))
    assert string == f"0/chatter/std_msgs::msg::dds_::String_/RIHS01_{GOLDEN['std_msgs/msg/String']}"
    alongside = Attachment(7, 1_700_000_000_123_456_789, bytes(range(16)))
    packed = alongside.packed()
    assert packed == struct.pack("<qqB", 7, 1_700_000_000_123_456_789, 16) + bytes(range(16))
    assert len(packed) == 33
    theirs = TheirAttachment.from_bytes(packed)
    assert (theirs.sequence_id, theirs.timestamp_ns, theirs.gid) == (7, 1_700_000_000_123_456_789, bytes(range(16)))
    assert Attachment.unpacked(packed) == alongside
    assert Attachment.unpacked(packed[:-1]) is None
    token = (
        "@ros2_lv/0/aa0b/0/11/MS/%/%/driver/%ego%drive/std_msgs::msg::dds_::String_/TypeHashNotSupported/::,10:,:,:,,"
    )
    endpoint = Endpoint.of(token)
    assert endpoint is not None
    assert (endpoint.topic, endpoint.type, endpoint.hash, endpoint.node) == (
        "/ego/drive", "std_msgs/msg/String", NO_HASH, "/driver",
    )  # fmt: skip
    assert endpoint.token() == token
    assert node_token(endpoint) == "@ros2_lv/0/aa0b/0/0/NN/%/%/driver"
    for none in ("", "@ros2_lv/0/a/0/0/NN/%/%/n", token.replace("/MS/", "/SS/"), token.replace("/0/", "/x/", 1)):
        assert Endpoint.of(none) is None


def test_another_library_reads_what_is_encoded() -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    head = {"stamp": {"sec": 5, "nanosec": 6}, "frame_id": "odom"}
    data = encode("nav_msgs/msg/Odometry", odometry_of(head, "base_link", 1.5, -2.25, 0.5, 0.75, 0.125))
    message: Any = store.deserialize_cdr(data, "nav_msgs/msg/Odometry")
    assert (message.header.stamp.sec, message.header.frame_id, message.child_frame_id) == (5, "odom", "base_link")
    assert (message.pose.pose.position.x, message.twist.twist.linear.x) == (1.5, 0.75)
    with pytest.raises(InputError, match="field 'speed' of geometry_msgs/msg/Twist: known: angular, linear"):
        encode("geometry_msgs/msg/Twist", {"speed": 1.0})
    newest = LatestMessage("nav_msgs/msg/Odometry", pose_paths(), "odom")
    newest.take(data)
    pose = PoseAndTwist.of(newest.read()[0], 0.1)
    assert pose.yaw == pytest.approx(0.5)
    assert (pose.x, pose.speed, pose.yaw_rate) == (pytest.approx(1.5 - 0.1 * 0.8775825618903728), 0.75, 0.125)


@pytest.mark.parametrize(("seconds", "nanoseconds"), [(0, 0), (0, 7), (5, 6), (1_764_108_000, 999_999_999)])
def test_a_stamp_is_decoded_to_whole_nanoseconds(seconds: int, nanoseconds: int) -> None:
    """A float would lose digits. The second of one transform has no stamp."""
    head = {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": "map"}
    data = encode("tf2_msgs/msg/TFMessage", {"transforms": [transform_of(head, "odom", 1.0, 2.0, 0.0)]})
    paths = ("transforms[0].header.stamp", "transforms[1].header.stamp")
    found = Decoder(Definitions(), "tf2_msgs/msg/TFMessage", paths)(data)
    assert list(found) == [seconds * 1_000_000_000 + nanoseconds, None]
    assert isinstance(found[0], int)


def test_foreign_messages_and_non_numbers_are_refused_and_a_repeated_stamp_is_not_new() -> None:
    now = [0.0]
    newest = LatestMessage("nav_msgs/msg/Odometry", pose_paths(), "odom", clock=lambda: now[0])

    def reported(x: float, frame: str = "odom", nanoseconds: int = 1) -> bytes:
        head = {"stamp": {"sec": 5, "nanosec": nanoseconds}, "frame_id": frame}
        return encode("nav_msgs/msg/Odometry", odometry_of(head, "b", x, 0.0, 0.0, 0.0, 0.0))

    assert newest.read()[1] == float("inf")
    newest.take(reported(1.0))
    for bad in (
        reported(float("nan"), nanoseconds=2),
        reported(1.0, "map", 3),
        reported(1.0)[:90],
        b"",
        b"\0\7\0\0" + bytes(900),
    ):
        newest.take(bad)
    assert newest.refused == 5
    now[0] = 0.5
    newest.take(reported(1.0))
    assert newest.read()[1] == 0.5  # the same stamp again
    newest.take(reported(1.0, nanoseconds=4))
    assert newest.read()[1] == 0.0


def test_a_car_is_driven_by_twist_as_by_ackermann() -> None:
    face = CarFace(0.32)
    for command in face.commands:
        fields = face.message(command, (1.2, 0.25), (0.0,) * 4)
        numbers = []
        for path in face.paths(command):
            value: Any = fields
            for step in path.split("."):
                value = value[step]
            numbers.append(value)
        assert face.action(command, tuple(numbers), (0.0,) * 4) == pytest.approx((1.2, 0.25))
    assert face.action("geometry_msgs/msg/Twist", (0.0, 2.0), (0.0,) * 4) == (0.0, 0.0)
    assert face.action("geometry_msgs/msg/Twist", (0.1, 9.0), (0.0,) * 4) == (0.1, 0.6)


def test_an_error_in_a_robot_file_is_named(tmp_path: Path) -> None:
    def refused(text: str) -> str:
        path = tmp_path / "robot.toml"
        path.write_text(text)
        with pytest.raises(InputError) as caught:
            load_robot_file(path)
        return str(caught.value)

    whole = WHOLE
    assert "format: wanted 2" in refused("")
    assert "odometry: missing; docs/guides/ros.md" in refused('format = 2\nrobot = "car"\n')
    assert "wire.domain: got 900, wanted 0 to 232" in refused(whole + "[wire]\ndomain = 900\n")
    assert "wire.form: got 'dds', wanted rmw_zenoh or bridge" in refused(whole + '[wire]\nform = "dds"\n')
    assert "odometry.largest_age: got 'x', wanted a finite number" in refused(
        whole.replace('topic = "/odom"\n', 'topic = "/odom"\nlargest_age = "x"\n')
    )
    assert "surroundings.field: got 3 numbers, wanted 4" in refused(whole.replace("[-4, 4, -4, 4]", "[1, 2, 3]"))
    assert "unknown key; did you mean 'odometry'" in refused(whole + "[odometri]\n")


def test_a_throttle_is_sent_as_a_speed_and_brakes_with_speed_zero() -> None:
    face = ThrottleCarFace(drive_gain=4.0)
    stamped, state = "ackermann_msgs/msg/AckermannDriveStamped", (0.0, 0.0, 0.0, 1.5)
    reported = face.message(stamped, (0.5, 0.1), state)["drive"]
    assert reported == {"speed": pytest.approx(1.5 + 0.2 * 4.0 * 0.5), "steering_angle": 0.1}
    assert face.action(stamped, (reported["speed"], 0.1), state) == pytest.approx((0.5, 0.1))
    assert face.action(stamped, (9.0, 0.1), state) == (1.0, 0.1)
    action, fields = face.brake(stamped, (0.0, 0.0), state)
    assert fields["drive"]["speed"] == 0.0, "not the speed that it has"
    assert action == (-1.0, 0.0)
    assert face.brake("geometry_msgs/msg/Twist", (0.0, 0.0), ())[1]["linear"]["x"] == 0.0
    assert CarFace().brake(stamped, (0.0, 0.0), state) == ((0.0, 0.0), {"drive": {"speed": 0.0, "steering_angle": 0.0}})


def test_the_gateway_of_a_throttle_car_uses_its_interface_and_that_of_a_turtlebot_a_twist(tmp_path: Path) -> None:
    path = tmp_path / "robot.toml"
    path.write_text(WHOLE, "utf-8")
    asked = load_robot_file(path)
    assert isinstance(load_ros_interface(asked)[0], CarFace)
    assert not isinstance(load_ros_interface(asked)[0], ThrottleCarFace)
    face, limits, _ = load_ros_interface(replace(asked, model="dart_car"))
    assert isinstance(face, ThrottleCarFace)
    assert limits[1][0] == 1.0
    with pytest.raises(InputError, match="model 'pendulum'"):
        load_ros_interface(replace(asked, model="pendulum"))
    turtlebot = load_robot_file(Path(__file__).parents[2] / "docs" / "examples" / "turtlebot.toml")
    face, limits, period = load_ros_interface(turtlebot)
    assert (limits[1], period) == ((0.5, 1.9), 0.05)
    assert turtlebot.command.type in face.commands


def test_the_script_for_a_test_with_ros_itself_is_valid_as_far_as_can_be_checked_without_ros(tmp_path: Path) -> None:
    folder = Path(__file__).parents[2] / "deploy" / "ros"
    assert load_robot_file(folder / "robot.toml").command.topic == "/drive"
    compile((folder / "robot.py").read_text("utf-8"), "robot.py", "exec")
    (tmp_path / "bin").mkdir()
    for name in ("dirname", "sh"):
        (tmp_path / "bin" / name).symlink_to(shutil.which(name) or "/bin/sh")
    done = subprocess.run(
        ["/bin/sh", str(folder / "try.sh")],
        env={"PATH": str(tmp_path / "bin")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (2, "try.sh: wanted docker or podman on PATH\n")
