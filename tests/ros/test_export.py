"""A recorded drive as a rosbag2: read by other libraries and by this one, without loss of precision."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests import messages
from tests.messages import stamp

from safedpa.bus.messages.codec import encode
from safedpa.bus.messages.messages import ScanMessage, StateMessage, VerdictMessage
from safedpa.bus.messages.topics import HEALTH, SCAN, STATE, key_of
from safedpa.errors import InputError, RunError
from safedpa.records import McapRecorder, load_run, read_messages
from safedpa.records.column_map.file import parse_column_map
from safedpa.records.readers.mcap import read_recording
from safedpa.replay.ros2_bag import export_bag
from safedpa.robots.car.system import CAR
from safedpa_services.command_line.group import safedpa

MAP = """
format = 1
robot = "car"
[columns]
t = { topic = "/r1/odom", clock = "receipt" }
x = { topic = "/r1/odom", field = "pose.pose.position.x" }
y = { topic = "/r1/odom", field = "pose.pose.position.y" }
yaw = { topic = "/r1/state", field = "position[2]" }
speed = { topic = "/r1/odom", field = "twist.twist.linear.x" }
target_speed = { topic = "/r1/nominal", field = "position[0]" }
steer = { topic = "/r1/nominal", field = "position[1]" }
"""


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("drive")
    arguments = ["up", "--headless", "--lockstep", "--seconds", "6", "--seed", "3", "--out", str(out)]
    done = subprocess.run([sys.executable, "-m", "safedpa_services", *arguments], capture_output=True, check=False)
    assert done.returncode == 0, done.stderr
    return next(out.glob("*/recording.mcap"))


def test_another_library_reads_the_recorded_drive_from_the_bag(drive: Path, tmp_path: Path) -> None:
    from rosbags.highlevel import AnyReader

    out = tmp_path / "bag"
    exported = export_bag(drive, out)
    ticks = read_recording(drive)
    verdicts = [message for _, _, message in read_messages(drive) if isinstance(message, VerdictMessage)]
    reported: dict[str, list[Any]] = {}
    with AnyReader([out]) as reader:
        for connection, _, raw in reader.messages():
            reported.setdefault(connection.topic, []).append(reader.deserialize(raw, connection.msgtype))
    assert sum(map(len, reported.values())) == exported.messages
    places = [(m.pose.pose.position.x, m.pose.pose.position.y, m.twist.twist.linear.x) for m in reported["/r1/odom"]]
    assert places == [(row[0], row[1], row[3]) for row in ticks.states.tolist()]
    assert [list(m.position) for m in reported["/r1/state"]] == ticks.states.tolist()
    assert reported["/r1/state"][0].name == list(CAR.state_names)
    commands = [(m.drive.speed, m.drive.steering_angle) for m in reported["/r1/command"]][1:]
    np.testing.assert_allclose(commands, ticks.actions[:-1], rtol=1e-6)
    notice = [m.status[0] for m in reported["/diagnostics"]]
    assert [one.message for one in notice] == [verdict.sentence for verdict in verdicts]
    assert {one.level for one, verdict in zip(notice, verdicts, strict=True) if verdict.status == "passed"} == {0}
    assert {marker.ns for m in reported["/r1/markers"] for marker in m.markers} == {"obstacles", "predicted"}
    assert all(m.transforms[0].child_frame_id == "r1/base_link" for m in reported["/tf"])
    stamps = [m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec for m in reported["/r1/odom"]]
    np.testing.assert_allclose(np.diff(stamps), 0.05, atol=1e-6, err_msg="in lockstep messages are sent much faster")


def test_the_bag_can_be_loaded_as_a_run(drive: Path, tmp_path: Path) -> None:
    export_bag(drive, tmp_path / "bag")
    ticks = read_recording(drive)
    columns = parse_column_map(MAP)
    from safedpa.records.readers.bags import read_log_table, topic_log

    table = read_log_table(topic_log(tmp_path / "bag"), columns, CAR)
    assert table.columns["/r1/odom:pose.pose.position.x"].tolist() == ticks.states[:, 0].tolist()
    assert table.columns["/r1/state:position[2]"].tolist() == ticks.states[:, 2].tolist()


def test_rerun_reads_the_bag(drive: Path, tmp_path: Path) -> None:
    export_bag(drive, tmp_path / "bag")
    (file,) = (tmp_path / "bag").glob("*.mcap")
    command = [sys.executable, "-m", "rerun", "mcap", "convert", str(file), "-o", str(tmp_path / "bag.rrd")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "bag.rrd").stat().st_size > 10_000


def test_the_command_reports_the_bag_and_replaces_nothing(drive, tmp_path, capsys):
    out = tmp_path / "bag"
    arguments = ["export", str(drive), "--format", "ros2", "--out", str(out)]
    assert safedpa.run(arguments) == 0
    assert "ros2 bag play" in capsys.readouterr().out
    assert safedpa.run(arguments) == 2
    assert "exists already; name a new folder" in capsys.readouterr().err


def test_a_file_that_is_no_recording_is_refused(tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    log.write_text("t,x\n0,0\n")
    with pytest.raises(RunError):
        export_bag(log, tmp_path / "bag")
    with pytest.raises(InputError, match="exists already"):
        export_bag(log, tmp_path)
    with pytest.raises(RunError):
        load_run(log, CAR, parse_column_map(MAP))


def state_of(values: int, applied: int, tick: int = 0, **changes: Any) -> StateMessage:
    """Returns a state with a number of values, and a field."""
    what = {**stamp(tick), "publish_time": 1.0, "lockstep": True, "field": (-1.0, 1.0, -1.0, 1.0), **changes}
    return messages.state_of(*[0.0] * values, applied=(0.0,) * applied, **what)


def states_in_the_bag(folder: Path, *states: StateMessage) -> list[Any]:
    """Returns the exported messages of a recording with these states."""
    from rosbags.highlevel import AnyReader

    with McapRecorder(folder / "a.mcap") as recorder:
        for number, state in enumerate(states):
            recorder.write(key_of("fleet", "r1", STATE), encode(state), number, number)
        path = recorder.path
    export_bag(path, path.with_suffix(""))
    with AnyReader([path.with_suffix("")]) as reader:
        found = [(line, raw) for line, _, raw in reader.messages() if line.topic == "/r1/state"]
        return [reader.deserialize(raw, line.msgtype) for line, raw in found]


def test_a_state_that_is_repeated_in_lockstep_is_exported_once(tmp_path: Path) -> None:
    states = [state_of(4, 2), state_of(4, 2, publish_time=1.1), state_of(4, 2, tick=1)]
    assert len(states_in_the_bag(tmp_path, *states)) == 2


def test_a_robot_without_a_setup_is_known_by_its_numbers_and_by_whether_it_drives_in_a_field(tmp_path: Path) -> None:
    """A ROS robot drives in a plane; a pendulum has no field."""
    (car,) = states_in_the_bag(tmp_path, state_of(4, 2))
    assert car.name == list(CAR.state_names)
    for field in ((), (-1.0, 1.0, -1.0, 1.0)):
        (pendulum,) = states_in_the_bag(tmp_path, state_of(2, 1, field=field))
        assert pendulum.name == ["angle", "rate"]
    for unknown in (state_of(12, 2), state_of(4, 6), state_of(4, 2, field=())):
        with pytest.raises(RunError, match="no known kind of robot"):
            states_in_the_bag(tmp_path, unknown)


def test_scans_are_exported_with_their_mount_and_commands_with_the_type_that_the_driver_received(
    tmp_path: Path,
) -> None:
    from rosbags.highlevel import AnyReader

    scan = ScanMessage(
        **stamp(1), source="laser", mount=(0.2, 0.0, 0.5), first_angle=-1.0, angle_step=0.5, ranges=(1.5, -1.0, 9.0),
        nearest=0.1, farthest=8.0, number=1,
    )  # fmt: skip
    health = messages.health_of("robot", commands="geometry_msgs/msg/TwistStamped")
    with McapRecorder(tmp_path / "a.mcap") as recorder:
        kinds = ((STATE, state_of(5, 2)), (SCAN, scan), (HEALTH, health), (STATE, state_of(5, 2, tick=1)))
        for number, (topic, message) in enumerate(kinds):
            key = key_of("fleet", "r1", topic, "robot") if topic is HEALTH else key_of("fleet", "r1", topic)
            recorder.write(key, encode(message), number, number)
        path = recorder.path
    export_bag(path, tmp_path / "bag")
    with AnyReader([tmp_path / "bag"]) as reader:
        found: dict[str, Any] = {
            line.topic: reader.deserialize(raw, line.msgtype) for line, _, raw in reader.messages()
        }
    assert found["/r1/scan"].ranges.tolist() == pytest.approx([1.5, np.nan, np.inf], nan_ok=True)
    assert found["/r1/scan"].header.frame_id == found["/tf_static"].transforms[0].child_frame_id == "r1/laser"
    assert found["/tf_static"].transforms[0].transform.translation.x == 0.2
    assert type(found["/r1/command"]).__name__.endswith("TwistStamped")


@pytest.mark.long
@pytest.mark.processes
@pytest.mark.parametrize(("robot", "model"), [("car", "dart_car"), ("differential_drive", "differential_drive")])
def test_the_command_of_a_throttle_or_a_differential_drive_is_a_speed_in_the_bag(tmp_path, robot, model):
    from rosbags.highlevel import AnyReader

    phrase = ["up", "--robot", robot, "--model", model, "--headless", "--lockstep", "--seconds", "3", "--seed", "3"]
    assert safedpa.run([*phrase, "--out", str(tmp_path / "runs"), "--no-diagnosis"]) == 0
    (recording,) = (tmp_path / "runs").glob("*/recording.mcap")
    export_bag(recording, tmp_path / "bag")
    states = [m for _, _, m in read_messages(recording) if isinstance(m, StateMessage)]
    ticks = {(state.epoch, state.tick): state for state in states}
    with AnyReader([tmp_path / "bag"]) as reader:
        reported: list[Any] = [
            reader.deserialize(raw, line.msgtype) for line, _, raw in reader.messages() if line.topic == "/r1/command"
        ]
    assert len(reported) == len(ticks)
    for message, state in zip(reported, ticks.values(), strict=True):
        speed = message.drive.speed if robot == "car" else message.linear.x
        wanted = state.values[3] + 0.2 * 4.48 * state.applied[0] if robot == "car" else state.applied[0]
        assert speed == pytest.approx(wanted, abs=1e-5)
