"""The robot's side: its router and its processes, by another implementation of ROS 2 over Zenoh."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from safedpa_lab.ros.side import Side
from safedpa_lab.ros.side import side as robot_side


@pytest.fixture
def side(tmp_path: Path) -> Iterator[Side]:
    with robot_side(tmp_path) as found:
        yield found
