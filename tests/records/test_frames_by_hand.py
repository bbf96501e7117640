"""Frames that a map names, held against what each message of a topic says it is measured in."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa.errors import ColumnMapError, RunError
from safedpa.records.bags.series import Series, _check_frames

ODOMETRY = {"header.frame_id": frozenset({"odom"}), "child_frame_id": frozenset({"/base"})}


@pytest.mark.parametrize(
    ("said", "wanted", "problem"),
    [
        (ODOMETRY, {"frame_id": "odom", "child_frame_id": "base"}, ""),
        (ODOMETRY, {"frame_id": "/odom"}, ""),
        (ODOMETRY, {"frame_id": "map"}, "frame_id is 'odom', wanted 'map' as the map says"),
        (ODOMETRY, {"frame_id": "odom", "child_frame_id": "odom"}, "child_frame_id is '/base', wanted 'odom'"),
        ({"header.frame_id": frozenset({"odom", "map"})}, {"frame_id": "odom"}, "frame_id is 'map', 'odom', wanted"),
        ({"header.frame_id": frozenset({"odom"})}, {"child_frame_id": "base"}, "has no child_frame_id; remove it"),
        ({"child_frame_id": frozenset({"base"})}, {"frame_id": "odom"}, "has no frame_id; remove it from [frames]"),
        ({}, {"frame_id": "odom"}, "has no frame_id; remove it"),
    ],
)
def test_a_topic_in_another_frame_or_in_none_is_refused(said: Any, wanted: dict[str, str], problem: str) -> None:
    nothing = np.zeros(0, dtype=np.int64)
    log: Any = SimpleNamespace(path="a.bag")
    columns: Any = SimpleNamespace(name="map.toml", frames={"/odom": wanted})
    found = {"/odom": Series(nothing, None, {}, said), "/drive": Series(nothing, None, {}, {})}
    if not problem:
        _check_frames(log, columns, found)
        return
    with pytest.raises(RunError) as caught:
        _check_frames(log, columns, found)
    assert str(caught.value).startswith("a.bag: topic '/odom'")
    assert problem in str(caught.value)


def test_a_frame_of_a_topic_that_no_column_takes_is_refused() -> None:
    log: Any = SimpleNamespace(path="a.bag")
    columns: Any = SimpleNamespace(name="map.toml", frames={"/tf": {"frame_id": "map"}})
    with pytest.raises(ColumnMapError, match=r"^map.toml: frames: no column is of topic '/tf'; remove the entry$"):
        _check_frames(log, columns, {"/odom": Series(np.zeros(0, dtype=np.int64), None, {})})
