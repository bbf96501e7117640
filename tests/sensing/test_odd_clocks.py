"""Clocks that stand still, leap or run ahead, headings that wrap, sources that overtake each other, few discs."""

from __future__ import annotations

import warnings
from dataclasses import replace
from math import pi

import numpy as np
import pytest

from safedpa.bus import SURROUNDINGS, ScanMessage, StateMessage, SurroundingsMessage
from safedpa.perception import PerceptionNode
from safedpa.perception.hiding import Hiding
from safedpa.perception.odometry import Odometry
from safedpa.perception.surroundings import covering

PERIOD = 0.05
RAYS = 360


def state_of(tick: int, yaw: float = 0.0, epoch: int = 1, robot_time: float | None = None) -> StateMessage:
    return StateMessage(
        epoch=epoch,
        tick=tick,
        robot_time=tick * PERIOD if robot_time is None else robot_time,
        publish_time=0.0,
        values=(0.0, 0.0, yaw, 0.0),
        applied=(0.0, 0.0),
        applied_by="filter",
        period=PERIOD,
        lockstep=True,
        goal=(),
        obstacles=(),
        field=(),
        footprint=(0.2, 0.2, 0.15),
        sources=("laser",),
    )


def scan_of(number: int, time: float, tick: int, yaw: float = 0.0, epoch: int = 1) -> ScanMessage:
    """Of a round wall at 3 m, and a post of 0.2 m radius at (1.5, 0)."""
    angles = yaw + 2.0 * pi / RAYS * np.arange(RAYS)
    along, across = 1.5 * np.cos(angles), 1.5 * np.sin(angles)
    hits = (np.abs(across) < 0.2) & (along > 0.0)
    near = along - np.sqrt(np.where(hits, 0.2**2 - across**2, 0.0))
    noise = np.random.default_rng(number).normal(0.0, 0.003, RAYS)
    return ScanMessage(
        epoch=epoch,
        tick=tick,
        robot_time=time,
        publish_time=0.0,
        source="laser",
        mount=(0.0, 0.0, 0.0),
        first_angle=0.0,
        angle_step=2.0 * pi / RAYS,
        ranges=tuple((np.where(hits, near, 3.0) + noise).tolist()),
        nearest=0.02,
        farthest=8.0,
        number=number,
    )


def step(node: PerceptionNode, state: StateMessage) -> SurroundingsMessage:
    message = node.step("r", state, {})[SURROUNDINGS]
    assert isinstance(message, SurroundingsMessage)
    return message


def test_a_scan_between_two_headings_that_wrap_is_laid_the_short_way_round() -> None:
    odometry = Odometry()
    odometry.add(0.0, (0.0, 0.0, pi - 0.01))
    odometry.add(0.1, (1.0, 0.0, -pi + 0.03))
    found = odometry.at(0.05)
    assert found is not None
    assert found == pytest.approx((0.5, 0.0, pi + 0.01))


def test_a_robot_that_heads_west_with_a_wrapped_heading_is_believed() -> None:
    """As a ROS gateway reports it: the heading comes from a quaternion."""
    node = PerceptionNode()
    for tick in range(60):
        true = pi + 0.02 * (1 if tick % 2 else -1)
        if tick:
            node.hear("r", scan_of(tick, (tick - 0.5) * PERIOD, tick - 1, yaw=pi))
        message = step(node, state_of(tick, yaw=float(np.arctan2(np.sin(true), np.cos(true)))))
        if tick > 10:
            assert not message.amiss
            assert min(np.hypot(x - 1.5, y) - radius for x, y, radius in message.points) < 0.25
            assert min(np.hypot(x + 1.5, y) - radius for x, y, radius in message.points) > 1.0


def test_a_clock_that_repeats_a_tick_breaks_nothing() -> None:
    odometry = Odometry()
    odometry.add(1.0, (0.0, 0.0, 0.0))
    odometry.add(1.0, (1.0, 0.0, 0.0))
    assert odometry.at(1.0 + 5e-10) == (1.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("ahead", "tells_tick"), [(0.3, True), (3.0, True), (100.0, True), (3.0, False), (100.0, False)]
)
def test_a_source_whose_clock_runs_ahead_is_not_believed_when_the_robots_clock_comes_there(
    ahead: float, tells_tick: bool
) -> None:
    node = PerceptionNode()
    for tick in range(120):
        time = tick * PERIOD + 0.01 + ahead
        node.hear("r", scan_of(tick, time, tick if tells_tick else int(time / PERIOD)))
        message = step(node, state_of(tick + 1))
        assert message.ages == (-1.0,)
    assert message.amiss == (
        f"the source laser tells scans from {ahead - PERIOD + 0.01:.2f} s ahead of the robot's clock",
    )


def test_after_a_leap_backwards_no_scan_of_before_is_believed_later() -> None:
    node = PerceptionNode()
    for tick in range(1, 60):
        node.hear("r", scan_of(tick, tick * PERIOD - 0.01, tick - 1))
        step(node, state_of(tick))
    leap = 2.0
    node.hear("r", scan_of(60, 59 * PERIOD + 0.02, 59))
    for tick in range(60, 120):
        message = step(node, state_of(tick, robot_time=tick * PERIOD - leap))
    assert message.ages == (-1.0,)


def test_a_scan_that_comes_before_the_state_after_it_waits_for_that() -> None:
    node = PerceptionNode()
    step(node, state_of(0))
    step(node, state_of(1))
    node.hear("r", scan_of(0, 2.4 * PERIOD, 2))
    assert step(node, state_of(2)).ages == (-1.0,)
    assert step(node, state_of(3)).ages == pytest.approx((0.6 * PERIOD,))


def test_a_scan_of_the_next_epoch_that_overtakes_its_state_counts_with_that_state() -> None:
    """A replay gives perception the recorded scans, and would miss it."""
    node = PerceptionNode()
    step(node, state_of(40))
    node.hear("r", scan_of(0, 0.0, 0, epoch=2))
    node.hear("r", scan_of(7, 2.02, 40))
    assert step(node, state_of(41)).scans == ((0.0, 7.0),)
    state = state_of(0, epoch=2)
    node.hear("r", replace(scan_of(1, 0.0, 0, epoch=2), source="another"))
    assert step(node, state).scans == ((0.0, 0.0),)


def test_a_late_scan_forgets_no_person_who_went_out_of_sight_since() -> None:
    hiding, none, all_of_it = Hiding(31, 0.2, 1.5), np.zeros((31, 31), bool), np.ones((31, 31), bool)
    hiding.look(0.9, all_of_it, none, none, none)
    somebody = none.copy()
    somebody[15, 15] = True
    beside = all_of_it.copy()
    beside[10:21, 10:21] = False
    hiding.look(1.0, beside, none, none, somebody)  # the newer one sees him, and nothing around him
    hiding.look(0.8, all_of_it, none, none, none)  # the other was there before him
    for time in (0.93, 1.06):
        hiding.wait(time)
    hiding.look(1.1, beside, none, none, none)
    assert hiding.present[15, 15]
    hiding.look(1.2, all_of_it, none, none, none)
    hiding.look(1.3, beside, none, none, none)
    assert not hiding.present[15, 15], "a look that is newer than he is rules him out"


@pytest.mark.parametrize("most", [7, 8, 12, 20])
def test_around_the_origin_the_allowed_number_of_discs_covers_everything(most: int) -> None:
    places = np.random.default_rng(0).uniform(-15.0, 15.0, (3000, 2))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = covering(places, np.full(len(places), 0.05), np.array((0.01, 0.02)), most)
    assert len(found) <= most
    apart = np.hypot(places[:, None, 0] - found[:, 0], places[:, None, 1] - found[:, 1])
    assert ((apart + 0.05 - found[:, 2]).min(axis=1) < 1e-9).all()


@pytest.mark.parametrize("gap", [1 / 40, 1 / 30, 0.05, 0.06, 0.07, 0.09, 0.1, 0.12])
@pytest.mark.parametrize("way", [(1, 0), (2, 1), (1, 1)])
def test_the_front_of_hidden_people_moves_at_their_top_speed_whatever_the_rate_of_scans(
    gap: float, way: tuple[int, int]
) -> None:
    """But for the cell that it is in, and 3 % of the way: it goes from cell to cell."""
    hiding, none, beside = Hiding(101, 0.2, 1.5), np.zeros((101, 101), bool), np.ones((101, 101), bool)
    beside[50, 50] = False
    hiding.look(0.0, beside, none, none, none)
    for look in range(1, int(1.2 / gap) + 1):
        hiding.look(look * gap, none, none, none, none)
        reached = max(n for n in range(25) if hiding.present[50 + n * way[0], 50 + n * way[1]])
        gone = 0.1 * float(np.hypot(*way))
        assert 1.5 * look * gap - reached * gone < gone + 0.03 * 1.5 * look * gap + 1e-9
