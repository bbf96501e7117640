"""Topics of different rates, clocks and frames become one table."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from safedpa.errors import ColumnMapError, RunError
from safedpa.records.column_map.column_map import ColumnMap
from safedpa.records.column_map.file import parse_column_map
from safedpa.records.readers.bags import AbstractLog, LoggedTopic, Series, read_log_table
from safedpa.records.readers.table import Table
from safedpa.robots.pendulum.system import PENDULUM

SECOND = 1_000_000_000


class Log(AbstractLog):
    """Topics with a number ``x`` each, held in memory."""

    def __init__(self, **topics: Series) -> None:
        super().__init__(Path("drive.bag"), "log in memory")
        self._found = topics

    def topics(self) -> Mapping[str, LoggedTopic]:
        return {name: LoggedTopic(name, "a/msg/B", len(one.receipt), 0, 1) for name, one in self._found.items()}

    def series(self, wanted: Mapping[str, tuple[str, ...]]) -> Mapping[str, Series]:
        return {name: self._found[name] for name in wanted}


def at(seconds: list[float], values: list[float] | None = None, late: float | None = 0.0, **frames: str) -> Series:
    """Messages stamped at ``seconds`` and received ``late`` seconds later; without stamps where that is None."""
    stamp = np.round(np.array(seconds) * SECOND).astype(np.int64)
    notice = {key.replace("header_", "header."): frozenset({name}) for key, name in frames.items()}
    x = np.arange(float(len(stamp))) if values is None else np.array(values)
    return Series(stamp + round((late or 0.0) * SECOND), None if late is None else stamp, {"x": x}, notice)


def columns(hold: str = "", clock: str = "header", more: str = "") -> ColumnMap:
    """Rows of the topic ``joint``; the torque comes from ``motor``, the rate from ``gyro`` where there is a hold."""
    return parse_column_map(
        f'format = 1\nrobot = "pendulum"\n[columns]\nt = {{ topic = "joint", clock = "{clock}" }}\n'
        f'angle = "joint:x"\ntorque = {{ topic = "motor", field = "x"{hold} }}\n{more}'
    )


def table(mapping: ColumnMap, **topics: Series) -> Table:
    return read_log_table(Log(**topics), mapping, PENDULUM)


@pytest.mark.parametrize(("hold", "stale", "first"), [(0.5, [2, 3], 2.0), (1.5, [3], 3.0), (2.5, [], 0.0)])
def test_a_value_is_held_until_it_is_too_old(hold: float, stale: list[int], first: float) -> None:
    """A row each second; the motor speaks at 0, 0.8 and 1 s, the last two in the other order in the file."""
    found = table(columns(f", hold = {hold}"), joint=at([0, 1, 2, 3]), motor=at([0, 1, 0.8], [10.0, 11.0, 9.0]))
    torque = found.columns["motor:x"]
    assert np.flatnonzero(np.isnan(torque)).tolist() == stale
    assert torque[:2].tolist() == [10.0, 11.0]
    kinds = [(one.kind, one.count, one.start_t) for one in found.findings]
    assert kinds == [("out_of_order", 1, 0.8), *([("stale_topic", len(stale), first)] if stale else [])]


@pytest.mark.parametrize(
    ("name", "age", "held"), [("torque", 0.4, True), ("torque", 0.6, False), ("rate", 0.09, True), ("rate", 0.2, False)]
)
def test_an_action_is_held_for_half_a_second_and_a_state_for_a_tenth(name: str, age: float, held: bool) -> None:
    other = at([1.0], [4.0])
    topics = {"joint": at([1.0 + age]), "motor": at([1.0 + age]), "gyro": at([1.0 + age])}
    topics["motor" if name == "torque" else "gyro"] = other
    found = table(columns(more='rate = "gyro:x"\n'), **topics)
    assert np.isfinite(found.columns["motor:x" if name == "torque" else "gyro:x"]).tolist() == [held]


def test_nothing_is_held_before_the_first_message() -> None:
    found = table(columns(", hold = 9"), joint=at([0, 5, 6]), motor=at([5]))
    assert np.isnan(found.columns["motor:x"]).tolist() == [True, False, False]
    assert [(one.count, one.start_t) for one in found.findings] == [(1, 0.0)]


@pytest.mark.parametrize(
    ("rows_late", "other_late", "reported"),
    [
        (0.0, 0.0, ""),
        (0.00005, 0.0, ""),
        (0.0125, 0.0, "12.5 ms later"),
        (-0.0125, 0.0, "-12.5 ms later"),
        (0.3, -0.1, "300.0 ms later"),
        (30.0, 30.0, "30000.0 ms later"),
        (0.6, 0.0, "two clocks"),
        (0.0, 0.6, "two clocks"),
        (0.0, -0.6, "two clocks"),
        (0.6, None, "two clocks"),
    ],
)
def test_stamps_half_a_second_apart_are_two_clocks(rows_late: float, other_late: float | None, reported: str) -> None:
    topics = {"joint": at([0, 1, 2, 3, 4], late=rows_late), "motor": at([0, 1, 2, 3, 4], late=other_late)}
    if reported == "two clocks":
        with pytest.raises(RunError, match=r"0\.6 s apart: two clocks"):
            table(columns(", hold = 9"), **topics)
    else:
        found = [one.message for one in table(columns(", hold = 9"), **topics).findings if one.kind == "stamps"]
        assert [reported in sentence for sentence in found] == [True] * bool(reported)


def test_a_command_without_a_stamp_belongs_to_the_row_of_its_time_if_its_receipt_is_rounded() -> None:
    """Commands and rows are of one time; every other command has no stamp, and receipts were kept as float64."""
    seconds = [1_700_000_000 + 0.05 * row for row in range(40)]
    rows, commands = at(seconds, late=0.003), at(seconds, late=-0.001)
    rounding = 256 * np.arange(-20, 20) // 20
    unstamped = np.where(np.arange(40) % 2, 0, commands.stamp)
    motor = replace(commands, receipt=commands.receipt + rounding, stamp=unstamped)
    found = table(columns(), joint=rows, motor=motor)
    assert found.columns["motor:x"].tolist() == list(range(40))


def test_rows_by_receipt_ignore_the_stamps() -> None:
    found = table(columns(", hold = 9", "receipt"), joint=at([0, 1], late=7.0), motor=at([6.5]))
    assert found.columns["joint:@receipt"].tolist() == [7.0, 8.0]
    assert not found.findings


@pytest.mark.parametrize(
    ("frames", "wanted", "problem"),
    [
        ({"header_frame_id": "odom", "child_frame_id": "/base"}, {"frame_id": "/odom", "child_frame_id": "base"}, ""),
        ({"header_frame_id": "odom"}, {"frame_id": "map"}, "frame_id is 'odom', wanted 'map' as the map says"),
        ({"child_frame_id": "/base"}, {"child_frame_id": "odom"}, "child_frame_id is '/base', wanted 'odom'"),
        ({"header_frame_id": "odom"}, {"child_frame_id": "base"}, "has no child_frame_id; remove it"),
        ({"child_frame_id": "base"}, {"frame_id": "odom"}, r"has no frame_id; remove it from \[frames\]"),
        ({}, {"frame_id": "odom"}, "has no frame_id; remove it"),
    ],
)
def test_a_topic_in_another_frame_than_the_map_names_is_refused(frames, wanted, problem):
    mapping = replace(columns(), frames={"joint": wanted})
    topics = {"joint": at([0.0], **frames), "motor": at([0.0])}
    if problem:
        with pytest.raises(RunError, match=f"^drive.bag: topic 'joint'.* ?{problem}"):
            table(mapping, **topics)
    else:
        table(mapping, **topics)


def test_all_frames_of_a_topic_must_agree_and_the_topic_must_be_used() -> None:
    both = replace(at([0.0]), frames={"header.frame_id": frozenset({"odom", "map"})})
    with pytest.raises(RunError, match="frame_id is 'map', 'odom', wanted"):
        table(replace(columns(), frames={"joint": {"frame_id": "odom"}}), joint=both, motor=at([0.0]))
    with pytest.raises(ColumnMapError, match=r"frames: no column is of topic '/tf'; remove the entry$"):
        table(replace(columns(), frames={"/tf": {"frame_id": "map"}}), joint=at([0.0]), motor=at([0.0]))
