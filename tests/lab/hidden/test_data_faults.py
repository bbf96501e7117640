"""Faults of the data of robots that do not ship: each changes the log, and its truth names what it changed."""

import numpy as np
import pytest

from safedpa_lab.own_robots.data_faults import FAULTS, GOOD, faulty_log, good_log
from safedpa_lab.own_robots.plants import PLANTS

pytestmark = pytest.mark.slow


def test_sixteen_faults_change_the_log_and_name_a_channel_and_a_time_of_it() -> None:
    good, plant = good_log("plain", "own_conveyor", 3), PLANTS["own_conveyor"]
    assert len(FAULTS) == 16
    for fault in FAULTS.values():
        log, truth = faulty_log(fault, "own_conveyor", 3)
        same = log.t.shape == good.t.shape and np.allclose(log.states, good.states)
        assert not (same and np.allclose(log.actions, good.actions)), fault.name
        assert set(truth.channels) <= {*plant.states, *plant.actions} or fault.name == "packets_dropped"
        assert truth.time is None or good.t[0] <= truth.time <= good.t[-1]


@pytest.mark.parametrize(("kind", "robot"), [("ordered_stop", "own_joint"), ("end_stop", "own_servo")])
def test_a_robot_that_is_braked_or_at_its_end_stop_reads_the_same_to_the_last_digit(kind: str, robot: str) -> None:
    assert kind in GOOD
    values = good_log(kind, robot, 3).states[:, 0]
    assert (np.diff(values) == 0.0).sum() > 100
