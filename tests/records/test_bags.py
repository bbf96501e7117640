"""Bags and flight logs, read as they are: against independent readers, damaged, packed, of wrong kinds."""

import gzip
import json
import math
import shutil
import sqlite3
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.records.ros_logs import LATE, PERIOD, START, bag, truth

from safedpa.errors import InputError, RunError
from safedpa.limits import LimitError
from safedpa.records import load_column_map, load_run
from safedpa.records.column_map.file import parse_column_map
from safedpa.records.readers.bags import kind_of, read_log_table, topic_log
from safedpa.robots.car.system import CAR, CAR_THROTTLE
from safedpa_services.command_line.group import safedpa

FORMS = ("mcap", "mcap-zstd", "mcap-file", "db3", "db3-file", "db3-message", "bag", "bag-bz2", "bag-lz4")
MAP = load_column_map("f1tenth_bag")
ROWS = 400


def read(path: Path, columns: Any = MAP) -> Any:
    return read_log_table(topic_log(path), columns, CAR)


@pytest.mark.parametrize("form", FORMS)
def test_every_form_gives_the_same_numbers_to_the_last_digit(tmp_path: Path, form: str) -> None:
    path = bag(tmp_path / "drive", form, ROWS)
    assert kind_of(path) == "topics"
    table, drive = read(path), truth(ROWS)
    assert table.columns["/odom:@header"].tolist() == [(START + k * PERIOD) / 1e9 for k in range(ROWS)]
    for target, source in (
        ("x", "pose.pose.position.x"),
        ("y", "pose.pose.position.y"),
        ("speed", "twist.twist.linear.x"),
    ):
        assert table.columns[f"/odom:{source}"].tolist() == drive[target].tolist()
    half = drive["yaw"] / 2
    yaws = [math.atan2(2.0 * math.cos(h) * math.sin(h), 1.0 - 2.0 * math.sin(h) ** 2) for h in half]
    assert table.columns["/odom:pose.pose.orientation"].tolist() == yaws
    for target, source in (("target_speed", "drive.speed"), ("steer", "drive.steering_angle")):
        wanted = drive[target].astype(np.float32).astype(float)
        assert table.columns[f"/drive:{source}"].tolist() == wanted.tolist()
    run = load_run(path, CAR, MAP)
    assert (len(run.t), len(run.stretches)) == (ROWS, 1)


def test_the_public_bag_equals_an_independent_reading_to_the_last_digit(data_folder: Path) -> None:
    from rosbags.highlevel import AnyReader

    path = data_folder / "dart_other_days" / "bags" / "4_sept_random_driving_fast.bag"
    rows, commands = [], {"/throttle_1": [], "/steering_1": []}
    with AnyReader([path]) as reader:
        for connection, at, raw in reader.messages():
            if connection.topic == "/vicon/jetracer1":
                message: Any = reader.deserialize(raw, connection.msgtype)
                stamp, place = message.header.stamp, message.pose.pose
                q = place.orientation
                yaw = math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))
                time = (stamp.sec * 1_000_000_000 + stamp.nanosec) / 1e9
                rows.append((time, place.position.x, place.position.y, yaw))
            elif connection.topic in commands:
                commands[connection.topic].append((at, reader.deserialize(raw, connection.msgtype).data))  # type: ignore[attr-defined]
    columns = load_column_map("dart_car_bag")
    table = read_log_table(topic_log(path), columns, CAR_THROTTLE)
    names = ("@header", "pose.pose.position.x", "pose.pose.position.y", "pose.pose.orientation")
    read_here = np.stack([table.columns[f"/vicon/jetracer1:{name}"] for name in names], axis=1)
    assert read_here.tolist() == [list(row) for row in rows]
    assert len(rows) == 3227
    for topic, reported in commands.items():
        times = [at for at, _ in reported]
        wanted = []
        for time, *_ in rows:
            newest = max((k for k, at in enumerate(times) if at <= round(time * 1e9) + 200), default=-1)
            fresh = newest >= 0 and time - times[newest] / 1e9 <= 0.3
            wanted.append(reported[newest][1] if fresh else math.nan)
        np.testing.assert_array_equal(table.columns[f"{topic}:data"], wanted)
    run = load_run(path, CAR_THROTTLE, columns)
    assert run.duration > 31.0
    assert any("5.9 ms later" in finding.message for finding in run.findings)


def test_the_public_flight_log_is_listed_and_read(data_folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from pyulog.core import ULog

    path = data_folder / "px4_ulog" / "sample_log_small.ulg"
    own = next(item for item in ULog(str(path)).data_list if item.name == "vehicle_local_position").data
    text = """
format = 1
robot = "car"
[columns]
t = { topic = "vehicle_local_position", clock = "header" }
x = { topic = "vehicle_local_position", field = "x" }
y = { topic = "vehicle_local_position", field = "y", flip = true }
yaw = { topic = "vehicle_attitude", field = "@yaw", flip = true }
speed = { topic = "vehicle_local_position", field = "vx" }
throttle = { topic = "actuator_controls_0", field = "control[3]" }
steer = { topic = "actuator_outputs#1", field = "output[0]", scale = 0.001 }
"""
    table = read_log_table(topic_log(path), parse_column_map(text), CAR_THROTTLE)
    assert table.columns["vehicle_local_position:x"].tolist() == own["x"].astype(float).tolist()
    assert table.columns["vehicle_local_position:@header"].tolist() == (own["timestamp"] * 1000 / 1e9).tolist()
    assert np.isfinite(table.columns["vehicle_attitude:@yaw"]).mean() > 0.9
    assert safedpa.run(["columns", str(path), "--robot", "car"]) == 0
    notice = capsys.readouterr().out
    assert "vehicle_local_position" in notice
    assert "flip = true" in notice


def test_the_clock_of_receipt_is_another_than_that_of_the_stamps(tmp_path: Path) -> None:
    path = bag(tmp_path / "drive", "mcap", 60)
    text = 't = { topic = "/odom", clock = "receipt" }\n'
    columns = parse_column_map(map_text().replace('t = { topic = "/odom", clock = "header" }\n', text))
    assert read(path, columns).columns["/odom:@receipt"][0] == (START + LATE) / 1e9
    assert not read(path, columns).findings
    (found,) = read(path).findings
    assert found.kind == "stamps"
    assert "3.0 ms later" in found.message


def map_text() -> str:
    from safedpa.records.column_map.file import shipped_column_maps

    return shipped_column_maps()["f1tenth_bag"].read_text(encoding="utf-8")


def test_a_map_without_t_takes_the_stamps_or_else_the_receipts(tmp_path: Path) -> None:
    columns = parse_column_map(map_text().replace('t = { topic = "/odom", clock = "header" }\n', ""))
    stamped, bare = bag(tmp_path / "a", "mcap", 50), bag(tmp_path / "b", "mcap", 50, header=False)
    assert read(stamped, columns).columns["/odom:@stamp"][0] == START / 1e9
    assert read(bare, columns).columns["/odom:@stamp"][0] == (START + LATE) / 1e9
    with pytest.raises(RunError, match=r"'/odom' has no time stamps; take clock = \"receipt\" for t$"):
        read(bare)


def test_a_command_is_held_until_it_is_too_old(tmp_path: Path) -> None:
    path = bag(tmp_path / "drive", "db3", 100)
    columns = parse_column_map(map_text().replace('drive.speed", hold = 0.5', 'drive.speed", hold = 0.05'))
    table = read(path, columns)
    fresh = np.isfinite(table.columns["/drive:drive.speed"])
    assert fresh.tolist() == [k % 5 <= 2 for k in range(100)]  # 0, 0.02, 0.04 s old
    assert np.isfinite(table.columns["/drive:drive.steering_angle"]).all()
    (stale,) = [finding for finding in table.findings if finding.kind == "stale_topic"]
    assert "40 rows of 100" in stale.message


def test_two_clocks_are_not_joined(tmp_path: Path) -> None:
    path = bag(tmp_path / "drive", "mcap", 50)
    moved = tmp_path / "moved.db3"
    shutil.copy(next(bag(tmp_path / "other", "db3", 50).glob("*.db3")), moved)
    with sqlite3.connect(moved) as base:  # one topic was received by another computer
        base.execute("UPDATE messages SET timestamp = timestamp + 86400000000000 WHERE topic_id = 1")
    with pytest.raises(RunError, match=r"8.64e\+04 s apart: two clocks.*clock = \"receipt\""):
        read(moved)
    assert len(read(path).columns["/odom:@header"]) == 50


def test_a_topic_in_another_frame_than_that_of_the_map_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="topic '/odom': frame_id is 'odom', wanted 'map' as the map says"):
        read(bag(tmp_path / "drive", "mcap", 50), parse_column_map(map_text() + 'frame_id = "map"\n'))


def test_chunks_packed_by_lz4_are_read(tmp_path: Path) -> None:
    from mcap.reader import make_reader
    from mcap.writer import CompressionType, Writer

    whole = next(bag(tmp_path / "drive", "mcap", 200).glob("*.mcap"))
    path = tmp_path / "packed.mcap"
    with whole.open("rb") as source, path.open("wb") as out:
        writer = Writer(out, compression=CompressionType.LZ4)
        writer.start()
        channels: dict[int, int] = {}
        for schema, channel, message in make_reader(source).iter_messages():
            if channel.id not in channels:
                assert schema is not None
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, number)
            writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()
    assert read(path).columns["/odom:pose.pose.position.x"].tolist() == truth(200)["x"].tolist()


CUT = {
    "mcap": lambda path: next(path.glob("*.mcap")),
    "bag": lambda path: path,
}


@pytest.mark.long
@pytest.mark.parametrize("form", ["mcap", "bag"])
@pytest.mark.parametrize("share", [0.35, 0.8, 0.999])
def test_a_bag_that_was_cut_off_is_read_up_to_there_and_without_its_index(tmp_path: Path, form: str, share: float):
    whole = CUT[form](bag(tmp_path / "drive", form, 12_000 if form == "mcap" else 4000))
    cut = tmp_path / f"cut{whole.suffix}"
    cut.write_bytes(whole.read_bytes()[: int(share * whole.stat().st_size)])
    table = read(cut)
    rows = len(table.columns["/odom:@header"])
    assert rows > 100
    assert table.columns["/odom:pose.pose.position.x"].tolist() == truth(12_000)["x"][:rows].tolist()
    assert [finding.kind for finding in table.findings if finding.kind == "cut_off"] == ["cut_off"]
    if share < 0.9:
        assert rows < len(read(whole).columns["/odom:@header"])


def test_a_bag_without_its_metadata_and_one_without_a_part_are_read(tmp_path: Path) -> None:
    path = bag(tmp_path / "drive", "db3", 100)
    about = path / "metadata.yaml"
    text = about.read_text()
    about.unlink()
    assert len(read(path).columns["/odom:@header"]) == 100
    about.write_text(text.replace("paths:\n  - drive.db3", "paths:\n  - drive.db3\n  - lost_1.db3"))
    (lost,) = [finding for finding in read(path).findings if finding.kind == "cut_off"]
    assert "1 of the bag's 2 files are missing (lost_1.db3)" in lost.message
    for file in path.glob("*.db3"):
        file.unlink()
    with pytest.raises(RunError, match=r"metadata.yaml names no existing file"):
        load_run(path, CAR, MAP)


def one_line(path: Path, columns: Any = MAP) -> str:
    with pytest.raises(InputError) as caught:
        load_run(path, CAR, columns)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_what_is_missing_is_named_with_what_is_there(tmp_path: Path) -> None:
    path = bag(tmp_path / "drive", "mcap", 50)
    wrong = parse_column_map(map_text().replace("/drive", "/cmd"))
    assert "topic '/cmd' does not exist; known: /drive, /odom" in one_line(path, wrong)
    wrong = parse_column_map(map_text().replace("twist.twist.linear.x", "twist.twist.linear.w"))
    assert "field 'twist.twist.linear.w' of nav_msgs/msg/Odometry: did you mean 'twist.twist.linear." in one_line(
        path, wrong
    )
    notice = one_line(path, None)
    assert "is a rosbag2 folder with 2 topics" in notice
    assert "/odom (nav_msgs/msg/Odometry, 50 Hz)" in notice
    assert f"'safedpa columns {path} --robot car > map.toml' proposes one" in notice
    assert "names no topic; wanted { topic = " in one_line(path, parse_column_map(PLAIN))


PLAIN = """
format = 1
robot = "car"
[columns]
t = "time"
x = "px"
y = "py"
yaw = "heading"
speed = "v"
target_speed = "u"
steer = "s"
"""


def test_an_unknown_type_is_named_with_its_cure_and_the_rest_is_read(tmp_path: Path) -> None:
    path = next(bag(tmp_path / "drive", "db3", 50).glob("*.db3"))
    with sqlite3.connect(path) as base:
        base.execute("UPDATE topics SET type = 'my_msgs/msg/Command' WHERE name = '/drive'")
        base.execute("DELETE FROM message_definitions")
    notice = one_line(path)
    assert "topic '/drive': type 'my_msgs/msg/Command': the log does not define it" in notice
    assert "rosbag2 --storage mcap" in notice
    assert topic_log(path).topics()["/odom"].fields
    assert topic_log(path).topics()["/drive"].problem


def test_a_bag_whose_types_stand_nowhere_is_read_by_the_known_ones(tmp_path: Path) -> None:
    """Humble's SQLite bags carry no definitions; ackermann_msgs is known here all the same."""
    path = next(bag(tmp_path / "drive", "db3", 50).glob("*.db3"))
    with sqlite3.connect(path) as base:
        base.execute("DROP TABLE message_definitions")
    assert len(read(path).columns["/drive:drive.speed"]) == 50


def test_an_empty_bag_and_an_empty_topic(tmp_path: Path) -> None:
    path = bag(tmp_path / "drive", "mcap", 0)
    assert "the bag contains no message; record again" in one_line(path)
    half = next(bag(tmp_path / "half", "db3", 50).glob("*.db3"))
    with sqlite3.connect(half) as base:
        base.execute("DELETE FROM messages WHERE topic_id = (SELECT id FROM topics WHERE name = '/drive')")
    assert "topic '/drive' has no message; record it, or leave it out of the map" in one_line(half)


def test_a_bag_whose_only_chunk_is_damaged_says_so(tmp_path: Path) -> None:
    path = next(bag(tmp_path / "bag", "mcap-zstd").glob("*.mcap"))
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    assert "the bag is damaged at one place, at byte" in one_line(path)


def test_a_file_of_another_program_is_named_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "a.ulg.gz").write_bytes(gzip.compress(b"ULog\x01\x12\x35\x01"))
    assert "is packed by gzip and no CSV file; unpack it: gunzip" in one_line(tmp_path / "a.ulg.gz")
    with zipfile.ZipFile(tmp_path / "a.xlsx", "w") as archive:
        archive.writestr("x", "1")
    assert "is a zip archive, or a spreadsheet" in one_line(tmp_path / "a.xlsx")
    with sqlite3.connect(tmp_path / "app.db3") as other:
        other.execute("CREATE TABLE notes (a)")
    assert "is a SQLite database, but no rosbag2" in one_line(tmp_path / "app.db3")
    whole = bag(tmp_path / "drive", "mcap", 50)
    assert f"is the metadata of a bag; name its folder, {whole}" in one_line(whole / "metadata.yaml")


def test_a_flight_log_that_ends_within_its_descriptions_is_refused_at_once(tmp_path: Path) -> None:
    """The library would read for ever: it steps back from what it does not know, beyond where it began."""
    path = tmp_path / "cut.ulg"
    path.write_bytes(b"ULog\x01\x12\x35\x01" + bytes(8) + b"\x05\x00Fa:b c" + b"\xff\x00\x99" + bytes(9))
    assert "is a damaged PX4 flight log; fetch it from the vehicle's card again" in one_line(path)


def test_names_that_are_no_text_or_have_line_ends_are_shown_on_one_line(tmp_path: Path) -> None:
    path = next(bag(tmp_path / "drive", "db3", 50).glob("*.db3"))
    with sqlite3.connect(path) as base:
        base.execute("UPDATE topics SET type = 'a/msg/B' || char(10) || 'C' WHERE name = '/drive'")
        base.execute("UPDATE topics SET serialization_format = CAST(x'fffe' AS TEXT) WHERE name = '/odom'")
    assert r"type 'a/msg/B\x0aC'" in one_line(path)
    assert "messages are encoded as" in topic_log(path).topics()["/odom"].problem
    assert topic_log(path).topics()["/drive"].type == r"a/msg/B\x0aC"


def test_a_schema_that_is_no_text_is_refused_in_one_line(tmp_path: Path) -> None:
    whole = next(bag(tmp_path / "drive", "db3", 50).glob("*.db3"))
    path = tmp_path / "spoilt.db3"
    content = whole.read_bytes().replace(b"messagesmessages", b"\xff\xffssagesmessages")
    path.write_bytes(content.replace(b"CREATE TABLE messages", b"CREATE TABL! messages"))
    assert "cannot be read as SQLite" in one_line(path)


def test_bombs_are_measured_before_they_are_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import zstandard

    packed = tmp_path / "bomb.mcap.zstd"
    packed.write_bytes(zstandard.compress(b"\x89MCAP0\r\n" + bytes(64 << 20), 19))
    with pytest.raises(LimitError, match="expansion factor of a compressed file"):
        load_run(packed, CAR, MAP)
    path = bag(tmp_path / "drive", "bag-bz2", 400)
    monkeypatch.setenv("SAFEDPA_LIMITS", "bag_chunk_bytes=1000")
    with pytest.raises(LimitError, match="SAFEDPA_LIMITS=bag_chunk_bytes=NUMBER"):
        load_run(path, CAR, MAP)


def test_the_proposed_map_is_read_and_drives_a_comparison(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = bag(tmp_path / "drive", "mcap", 800)
    assert safedpa.run(["columns", str(path), "--robot", "car"]) == 0
    text = capsys.readouterr().out
    (tmp_path / "map.toml").write_text(text)
    mine, shipped = read(path, parse_column_map(text)), read(path)
    assert {name: column.tolist() for name, column in mine.columns.items()} == {
        name: column.tolist() for name, column in shipped.columns.items()
    }
    assert "# /odom   nav_msgs/msg/Odometry, 800 messages, 50 Hz" in text
    arguments = ["compare", "car", str(path), "--columns", str(tmp_path / "map.toml"), "--out", str(tmp_path), "--json"]
    assert safedpa.run(arguments) == 0
    assert json.loads(capsys.readouterr().out)["runs"]


def test_a_table_is_mapped_too_and_json_is_one_document(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = tmp_path / "log.csv"
    log.write_text("time [ms],pos x,pos y,heading [deg],v,throttle,steering\n0,0,0,0,0,0,0\n")
    assert safedpa.run(["columns", str(log), "--robot", "car", "--json"]) == 0
    reported = json.loads(capsys.readouterr().out)
    columns = parse_column_map(reported["map"])
    assert columns.sources == ("time [ms]", "pos x", "pos y", "heading [deg]", "v", "throttle", "steering")
    assert reported["topics"] == []
