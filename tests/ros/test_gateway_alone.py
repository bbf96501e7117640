"""The gateway without a network: which actions it forwards, and when it brakes."""

import json
import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.ros.gateway_rig import ASKED, DRIVE, Link, Rig, Sense, rig_of

from safedpa.bus import HealthMessage, NominalMessage, ScanMessage, StateMessage, logging
from safedpa.perception import Rays
from safedpa_services.ros_gateway.robot_file import LocalisationTopic, ScanTopic
from safedpa_services.ros_gateway.sources import SourceReading

BRAKE = (0.0, 0.0)
LATE = "no action of the filter arrived in time"


@pytest.fixture
def rig() -> Iterator[Rig]:
    with rig_of() as made:
        yield made


def kinds(messages: Sequence[Any]) -> set[str]:
    return {type(message).__name__ for message in messages} - {"HealthMessage"}


@pytest.mark.parametrize(
    ("values", "sent"),
    [
        ((0.7, -0.2), True),
        ((2.0, 0.34), True),
        ((-0.6, -0.34), True),
        ((2.0 + 1e-10, -0.34 - 1e-10), True),  # rounded during transport
        ((2.001, 0.0), False),
        ((-0.601, 0.0), False),
        ((0.0, 0.341), False),
        ((0.0, -0.341), False),
        ((float("nan"), 0.0), False),
        ((0.7,), False),
        ((0.0, 0.0, 0.0), False),
    ],
)
def test_an_action_is_sent_unless_it_is_beyond_a_limit(rig: Rig, values: tuple[float, ...], sent: bool) -> None:
    rig.act(*values)
    assert rig.turns() == [values if sent else BRAKE]
    assert (rig.gateway.watchdog_ticks, rig.gateway.tick) == (int(not sent), 1)


@pytest.mark.parametrize(
    ("timing", "sent"),
    [
        ({"seconds": 0.04}, True),
        ({"seconds": 0.049}, False),  # after nine tenths of the period
        ({"held_up": 0.085}, True),  # the process slept, for less than two periods in all
        ({"held_up": 0.095}, False),
        ({"held_up": 1.0}, False),
        ({"tick": 99}, False),
        ({"tick": 1}, False),
        ({"epoch": 1}, False),  # of an earlier gateway
    ],
)
def test_an_action_is_sent_in_time_and_for_its_own_tick(rig: Rig, timing: dict[str, Any], sent: bool) -> None:
    rig.act(0.7, -0.2, **timing)
    assert rig.turns() == [(0.7, -0.2) if sent else BRAKE]
    (health,) = [message for message in rig.messages() if getattr(message, "state", "") == "braked"]
    assert len(health.latencies) == sent


def test_a_state_reports_its_age_until_its_action_acts(rig: Rig) -> None:
    """The age of the odometry, plus the average time to an action, which is updated by a tenth per action."""
    rig.odometry.age = 0.03
    rig.act(0.5, 0.1, seconds=0.02)
    rig.turns(3)
    states = [message for message in rig.messages() if isinstance(message, StateMessage)]
    assert [state.until_action for state in states] == pytest.approx([0.03, 0.032, 0.0338], abs=1e-5)
    assert [(state.applied, state.applied_by) for state in states] == [(BRAKE, "none")] + [((0.5, 0.1), "filter")] * 2


@pytest.mark.parametrize(
    ("age", "why"), [(0.1, LATE), (0.11, "the odometry is 0.11 s old"), (math.inf, "the odometry is missing")]
)
def test_an_odometry_older_than_a_tenth_of_a_second_brakes(rig: Rig, age: float, why: str) -> None:
    rig.odometry.age = age
    assert rig.turns() == [BRAKE]
    assert rig.gateway.why == why
    assert kinds(rig.messages()) == ({"StateMessage"} if why == LATE else set())
    rig.odometry.why = "two publishers"
    rig.turns()
    assert rig.gateway.why.endswith("; two publishers") is (why != LATE)


@pytest.mark.parametrize(("age", "why"), [(1.0, ""), (1.01, "1.01 s old"), (9.0, "9.00 s old"), (math.inf, "missing")])
def test_a_localisation_older_than_a_second_brakes(age: float, why: str) -> None:
    asked = replace(ASKED, localisation=LocalisationTopic("/tf"))
    with rig_of(asked=asked, localised=Sense((0.0, 0.0, 0.0), age)) as rig:
        assert rig.turns() == [BRAKE]
        assert kinds(rig.messages()) == (set() if why else {"StateMessage"})
        assert rig.gateway.why == (f"the transform from map to odom is {why}" if why else LATE)


@pytest.mark.parametrize("numbers", [(0.0, 0.0, 0.0, 0.0), (1e200, 1e200, 1e200, 1e200)])
def test_an_odometry_without_a_rotation_brakes(rig: Rig, numbers: tuple[float, ...]) -> None:
    rig.odometry.numbers = (1.0, 2.0, 0.5, 0.0, *numbers)
    assert rig.turns() == [BRAKE]
    assert "not a rotation" in rig.gateway.why


def test_a_gateway_does_not_report_driving_before_it_received_a_message(rig: Rig) -> None:
    assert "no odometry has arrived" in rig.gateway.why


@pytest.mark.parametrize(("age", "counts"), [(0.0, True), (0.5, True), (0.51, False), (math.inf, False)])
def test_a_nominal_action_counts_for_half_a_second(age: float, counts: bool) -> None:
    with rig_of(nominal=Sense((0.5, 0.1), age)) as rig:
        rig.turns()
        heard = [message.values for message in rig.messages() if isinstance(message, NominalMessage)]
        assert heard == [(0.5, 0.1)] * counts


def test_without_a_policy_of_the_robot_no_nominal_action_is_sent(rig: Rig) -> None:
    rig.turns()
    assert kinds(rig.messages()) == {"StateMessage"}


def test_missed_periods_are_skipped(rig: Rig) -> None:
    """The process sleeps for 10 s after its first period."""
    times: list[float] = []

    def before(turn: int) -> None:
        times.append(rig.now[0])
        rig.now[0] += 10.0 if turn == 1 else 0.0

    rig.turns(6, before)
    assert times[1] - times[0] == pytest.approx(0.05, abs=0.01)
    assert times[5] - times[1] > 10.05, "otherwise the four periods after it would take no time"


def test_ticks_count_the_missed_periods(rig: Rig) -> None:
    """The state has moved for so long: a filter that knows of one period would find it implausible."""
    ticks: list[int] = []

    def before(turn: int) -> None:
        ticks.extend(message.tick for message in rig.messages() if isinstance(message, StateMessage))
        rig.now[0] += 0.42 if turn == 3 else 0.0

    rig.turns(6, before)
    assert ticks == [0, 1, 2, 11, 12]


def test_a_gateway_sends_a_heartbeat_four_times_a_second(rig: Rig) -> None:
    rig.turns(60)
    beats = [message.robot_time for message in rig.messages() if isinstance(message, HealthMessage)][:-1]
    assert 10 <= len(beats) <= 13
    assert all(0.2 < later - earlier <= 0.31 for earlier, later in pairwise(beats))


def test_each_reason_to_brake_is_logged_once_and_driving_again_too(rig: Rig, capsys: pytest.CaptureFixture[str]):
    ages = (0.0, 0.0, 0.11, 0.16, 0.0, 0.0)

    def before(turn: int) -> None:
        logging.EVENT_LOG.reset_rate_limits()
        rig.odometry.age = ages[turn]
        rig.act(*((0.5, 0.1) if turn != 4 else (9.0, 9.0)))

    assert rig.turns(6, before) == [(0.5, 0.1)] * 2 + [BRAKE] * 3 + [(0.5, 0.1)]
    notice = [json.loads(line)["sentence"] for line in capsys.readouterr().err.splitlines()]
    assert notice == [
        "the filter drives", "the gateway brakes: the odometry is 0.11 s old", f"the gateway brakes: {LATE}",
        "the filter drives",
    ]  # fmt: skip
    assert rig.gateway.watchdog_ticks == 3


@pytest.mark.parametrize(
    ("of_file", "heard", "goal"),
    [((), None, ()), ((3.0, 1.0), None, (3.0, 1.0)), ((3.0, 1.0), (), (3.0, 1.0)), ((3.0, 1.0), (0.0, 2.0), (0.0, 2.0)),
     ((), (0.0, 2.0), (0.0, 2.0))],
)  # fmt: skip
def test_a_received_goal_replaces_the_one_of_the_file(of_file, heard, goal):
    asked = replace(ASKED, surroundings=replace(ASKED.surroundings, goal=of_file))
    with rig_of(asked=asked, goal=None if heard is None else Sense(heard)) as rig:
        rig.turns()
        assert [message.goal for message in rig.messages() if isinstance(message, StateMessage)] == [goal]


@pytest.mark.parametrize(
    ("arrived", "delay", "tick", "measured"),
    [
        (0.0, 0.0, 20, 1.0),
        (-0.02, 0.0, 19, 0.98),
        (-0.02, 0.05, 18, 0.93),
        (-0.88, 0.05, 1, 0.07),
        (-0.02, 2.0, None, None),  # before the first state
        (+0.02, 0.0, 20, 1.0),  # after the newest odometry: it belongs to the state that is sent now
    ],
)
def test_a_scan_has_the_tick_and_the_time_at_which_it_was_measured(arrived, delay, tick, measured):
    """Measured at 1 s of robot time, after 20 ticks of 0.05 s."""
    rays = Rays((0.0, 0.0, 0.0), 0.0, 0.1, (1.0, 2.0), 0.1, 9.0)
    turn = SourceReading(100.0 + arrived, rays, np.empty((0, 2)))
    scanner = SimpleNamespace(take_all=lambda: [turn], refused=0, why="")
    asked = replace(ASKED, scans=(ScanTopic("/scan", delay=delay),))
    with rig_of(asked=asked, sources=(scanner,)) as rig:
        rig.gateway.tick = 20
        rig.turns()
        heard = [message for message in rig.messages() if isinstance(message, ScanMessage)]
    assert [message.tick for message in heard] == ([] if tick is None else [tick])
    assert [message.robot_time for message in heard] == ([] if measured is None else [pytest.approx(measured)])
    assert all((message.ranges, message.number) == ((1.0, 2.0), 1) for message in heard)


@pytest.mark.parametrize("form", ["rmw_zenoh", "bridge"])
@pytest.mark.parametrize("announced", [True, False])
@pytest.mark.parametrize("echo_monitor", [True, False])
def test_a_gateway_brakes_while_another_publisher_commands(form: str, announced: bool, echo_monitor: bool) -> None:
    """Announced publishers are named. A bridge does not announce publishers; they are detected by their messages."""
    link = Link(form, *[SimpleNamespace(node="/joystick", topic="/drive", type=DRIVE)] * announced)
    named = announced and form == "rmw_zenoh"
    with rig_of(link=link) as rig:
        rig.act(0.5, 0.1)
        if echo_monitor:
            rig.driver.take(b"")
            assert rig.drive.sent == [BRAKE], "it is answered at once"
        assert rig.turns() == [BRAKE if named or echo_monitor else (0.5, 0.1)]
        assert rig.gateway.why.startswith("/joystick publishes on /drive, too") is named
        assert rig.gateway.why.startswith("an unannounced publisher") is (echo_monitor and not named)
        rig.now[0] += 2.0
        assert rig.turns() == [BRAKE if named else (0.5, 0.1)], "one that fell silent is gone"


@pytest.mark.parametrize("period", [0.01, 0.05, 1.0])
def test_a_gateway_brakes_for_a_second_at_its_end_whatever_ended_it(rig, period, monkeypatch):
    slept: list[float] = []
    rig.gateway.period = period

    def broken() -> Any:
        raise ValueError("broken")

    monkeypatch.setattr(rig.odometry, "read", broken)
    monkeypatch.setattr(time, "sleep", slept.append)
    with pytest.raises(ValueError, match="broken"):
        rig.gateway.run(lambda: False)
    assert set(rig.drive.sent) == {BRAKE}
    assert len(rig.drive.sent) == len(slept) >= 10
    assert sum(slept) == pytest.approx(1.0)


def test_a_heartbeat_has_the_counts_of_the_gateway(rig: Rig) -> None:
    rig.act(9.0, 9.0)
    rig.turns(3)
    rig.gateway.refused = 5
    rig.act(0.5, 0.1)
    rig.turns(12)
    beat = [message for message in rig.messages() if isinstance(message, HealthMessage)][-1]
    assert (beat.service, beat.state) == ("robot", "braked")
    assert (beat.stale, rig.gateway.watchdog_ticks) == (3, 3)
    assert (beat.tick, beat.steps) == (rig.gateway.tick, rig.gateway.tick)
    assert beat.refused == 5
    assert beat.detail == rig.gateway.why
    assert beat.commands == DRIVE
    assert beat.software
    assert beat.pid > 0
