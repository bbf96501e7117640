"""A robot that stands though something is requested is noticed, with a reason, whatever robot it is."""

from math import cos, pi, sin

import pytest

from safedpa.bus import VerdictMessage
from safedpa.robots.car.system import CAR
from safedpa.robots.pendulum.system import PENDULUM
from safedpa.robots.point.system import POINT
from safedpa.safety.deadlock.detector import DeadlockDetector, Stand, position_entries, record_deadlock, what_to_do
from safedpa.systems import System, Variable

PERIOD = 0.05


def stood(seconds: float, nominal_speed: float, driven: float, creep: float = 0.0, noise: float = 0.0):
    """After so long at one place; metres a tick that the model promised under the nominal action and under the
    action."""
    standing, x = DeadlockDetector((0, 1)), 1.0
    for tick in range(round(seconds / PERIOD) + 1):
        here = (x + noise * (tick % 2), 0.0, 0.3)
        standing.update(here, PERIOD)
        standing.expect(here, (here[0] + nominal_speed, 0.0, 0.0), (here[0] + driven, 0.0, 0.0))
        x += creep
    return standing


def test_standing_despite_a_nominal_action_is_counted_and_reported_after_five_seconds() -> None:
    assert stood(4.9, 0.005, 0.0).reason("corrected", ("obstacle 0",), False) == ""
    later = stood(6.0, 0.005, 0.0)
    assert later.seconds == pytest.approx(6.0)
    reported = later.reason("corrected", ("obstacle 0", "left wall"), False)
    assert reported.startswith("boxed in: obstacle 0 and left wall")
    assert later.reason("relaxed", ("obstacle 0",), False).startswith("margin: obstacle 0")
    assert later.reason("corrected", ("obstacle 0",), True).startswith("margin")
    assert later.reason("fallback", (), False).startswith("no decision")


def test_an_action_that_should_move_it_and_does_not_lies_in_the_dead_band() -> None:
    standing = stood(6.0, 0.005, 0.001)
    assert standing.reason("corrected", ("obstacle 0",), False).startswith("dead band")
    assert standing.failed_displacement == pytest.approx(0.001)
    assert standing.is_inside_dead_band(0.0009)
    assert not standing.is_inside_dead_band(0.002), "a stronger action was not tried"
    assert standing.is_inside_dead_band(standing.failed_displacement)
    assert stood(0.45, 0.005, 0.001).failed_displacement == 0.0, "it takes half a second to see"
    assert stood(0.5, 0.005, 0.001).failed_displacement == pytest.approx(0.001)
    assert not DeadlockDetector((0,)).is_inside_dead_band(0.0), "nothing has failed"


@pytest.mark.parametrize("turns", [2, 8, 20])
def test_a_robot_that_its_policy_holds_in_place_has_no_dead_band(turns: int) -> None:
    """The nominal actions go back and forth, or round and round, as those of a boat at its buoy."""
    standing = DeadlockDetector((0, 1))
    for tick in range(160):
        standing.update((0.0, 0.0), PERIOD)
        angle = 2.0 * pi * tick / turns
        ahead = (0.005 * cos(angle), 0.005 * sin(angle))
        standing.expect((0.0, 0.0), ahead, ahead)
    assert standing.reason("passed", (), False) == ""
    assert standing.reason("fallback", (), False).startswith("no decision")


def test_what_is_not_meant_to_move_it_fails_at_nothing() -> None:
    assert stood(6.0, 0.005, 0.00005).failed_displacement == 0.0, "a hundredth of the nominal action"
    standing = DeadlockDetector((0,))
    for _ in range(20):
        standing.update((0.0,), PERIOD)
        standing.expect((0.0,), (0.5,), (0.01,))
    assert standing.failed_displacement == 0.0, "a fiftieth is no more than that"


def test_a_nominal_action_that_passes_now_and_then_and_moves_nothing_lies_in_the_dead_band() -> None:
    standing = DeadlockDetector((0,))
    for tick in range(122):
        standing.update((0.0,), PERIOD)
        standing.expect((0.0,), (0.005,), (0.0004 * (tick % 2),))
    assert standing.failed_displacement == 0.0
    assert standing.reason("passed", (), False).startswith("dead band")
    assert standing.reason("corrected", ("wall",), False).startswith("boxed in")


def test_a_stand_may_begin_with_a_promise() -> None:
    standing = DeadlockDetector((0,))
    assert (standing.seconds, standing.failed_displacement) == (0.0, 0.0)
    standing.expect((0.0,), (0.5,), (0.0,))
    standing.update((0.05,), PERIOD)
    assert standing.seconds == PERIOD, "a tenth of what was promised is standing"
    standing.expect((0.05,), (0.55,), (0.05,))
    standing.update((0.16,), PERIOD)
    assert standing.seconds == 0.0
    standing = DeadlockDetector((0,))
    for _ in range(102):
        standing.expect((0.0,), (0.05,), (0.0,))
        standing.update((0.0,), PERIOD)
    assert standing.reason("passed", (), False).startswith("boxed in"), "nothing was to move it"
    standing = DeadlockDetector((0,), seconds=6.0)
    standing.expect((0.0,), (0.5,), (0.01,))
    standing.update((0.0,), PERIOD)
    assert standing.reason("passed", (), False).startswith("boxed in"), "a fiftieth is not meant to move it"
    standing.seconds = 5.0
    assert standing.reason("passed", (), False) == "", "not for longer than that"


def test_a_state_without_the_places_ends_a_stand() -> None:
    standing = stood(6.0, 0.005, 0.001)
    standing.update((1.0,), PERIOD)
    assert standing.seconds == 0.0


@pytest.mark.parametrize(
    ("reason", "begins"),
    [
        ("dead band: the model says", "Free it"),
        ("no decision: the backup", "An input"),
        ("margin: obstacle 0", "Give it another goal or more room, roll back"),
        ("boxed in: obstacle 0", "Give it another goal or more room, or drive"),
    ],
)
def test_each_reason_has_its_cure(reason: str, begins: str) -> None:
    assert what_to_do(reason).startswith(begins)
    assert what_to_do(f"x {reason}") == ""


def test_noise_and_creeping_are_standing_but_driving_is_not() -> None:
    assert stood(6.0, 0.005, 0.001, creep=2e-5).seconds > 5.0
    assert stood(6.0, 0.005, 0.001, noise=1e-4).seconds > 5.0
    assert stood(6.0, 0.005, 0.001, creep=2e-4).seconds > 5.0, "it is the nominal action that is compared with"
    assert stood(6.0, 0.005, 0.004, creep=0.004).seconds == 0.0
    assert stood(6.0, 0.0, 0.0).seconds == 0.0, "nothing is requested"


def test_moving_again_and_requesting_nothing_end_a_stand() -> None:
    standing = stood(6.0, 0.005, 0.001)
    standing.update((1.5, 0.0, 0.0), PERIOD)
    assert (standing.seconds, standing.failed_displacement) == (0.0, 0.0)
    standing = stood(6.0, 0.005, 0.001)
    standing.interrupt()
    standing.update((1.0, 0.0, 0.3), PERIOD)
    assert standing.seconds == 0.0


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_the_unit_of_length_does_not_matter(unit: float) -> None:
    standing = DeadlockDetector((0,))
    for _ in range(121):
        standing.update((unit,), PERIOD)
        standing.expect((unit,), (1.005 * unit,), (1.001 * unit,))
    assert standing.seconds == pytest.approx(6.0)
    assert standing.reason("corrected", ("wall",), False).startswith("dead band")


def test_places_are_positions_or_what_is_no_rate() -> None:
    assert position_entries(CAR) == (0, 1)
    assert position_entries(POINT) == (0, 1)
    assert position_entries(PENDULUM) == (0,)
    tank = System("tank", (Variable("level", "%", 0.0, 1.0), Variable("inflow", "%/s", 0.0, 1.0)), ())
    assert position_entries(tank) == (0,)


@pytest.mark.parametrize(("ticks", "stationary_for"), [(1, True), (10, True), (11, False)])
def test_ticks_without_a_nominal_action_end_a_stand_only_where_they_last(ticks: int, stationary_for: bool) -> None:
    standing = DeadlockDetector((0,))
    for tick in range(220):
        standing.update((1.0,), PERIOD)
        if tick % 40 >= ticks:
            standing.expect((1.0,), (1.005,), (1.0,))
    assert (standing.seconds > 5.0) is stationary_for
    assert standing.reason("relaxed", ("wall",), False).startswith("margin" if stationary_for else "")


def test_half_a_second_without_a_nominal_action_is_forgiven() -> None:
    for ticks, stationary_for in ((2, True), (3, False)):
        standing = DeadlockDetector((0,))
        standing.expect((1.0,), (1.1,), (1.0,))
        for _ in range(1 + ticks):
            standing.update((1.0,), 0.25)
        assert (standing.seconds == 0.25 * (1 + ticks)) is stationary_for


def test_a_margin_remains_the_reason_though_a_last_little_push_failed() -> None:
    """Where the least-violation action dies away, its last half second moves no one; after that nothing pushes."""
    standing = DeadlockDetector((0,))
    for tick in range(200):
        standing.update((1.0,), PERIOD)
        standing.expect((1.0,), (1.005,), (1.0002 if tick < 12 else 1.0,))
    assert standing.failed_displacement > 0.0
    for status in ("relaxed", "violated"):
        assert standing.reason(status, ("wall",), True).startswith("margin: wall")
    assert standing.reason("corrected", ("wall",), True).startswith("dead band")
    pushing = stood(6.0, 0.005, 0.001)
    assert pushing.reason("relaxed", ("wall",), True).startswith("dead band"), "it is pushed all the time"


def test_moving_in_a_tick_without_a_nominal_action_ends_a_stand_and_without_promised_motion_there_is_none() -> None:
    standing = stood(6.0, 0.005, 0.0)
    standing.update((1.0, 0.0, 0.0), PERIOD)
    standing.update((1.5, 0.0, 0.0), PERIOD)
    assert standing.seconds == 0.0
    standing = DeadlockDetector((0,))
    standing.expect((1.0,), (1.0,), (1.0,))
    for _ in range(5):
        standing.update((1.0,), PERIOD)
    assert standing.seconds == 0.0


def verdict(time: float, stationary_for: float, why: str) -> VerdictMessage:
    return VerdictMessage(
        epoch=1, tick=round(time / PERIOD), robot_time=time, publish_time=0.0, status="corrected", sentence="",
        action=(), nominal=(), slack=0.0, active=(), h_now=0.0, h_next=0.0, margin=0.0, solver="", microseconds=0.0,
        stationary_for=stationary_for, stationary_reason=why,
    )  # fmt: skip


def test_stands_are_collected_one_by_one_and_the_reason_of_the_longest_part_counts() -> None:
    found: list[Stand] = []
    reported = (
        (3.0, 3.0, ""),
        (5.05, 5.05, "boxed in"),
        (5.1, 5.1, "dead band: it does not move"),
        (6.0, 0.0, ""),
        (20.0, 6.0, "margin"),
    )
    for item in reported:
        record_deadlock(found, verdict(*item))
    assert found == [
        {"from": 0.0, "seconds": 5.1, "reason": "boxed in", "reasons": {"boxed in": 5.05, "dead band": 0.05}},
        {"from": 14.0, "seconds": 6.0, "reason": "margin", "reasons": {"margin": 6.0}},
    ]


def test_stands_are_one_where_they_began_together() -> None:
    found: list[Stand] = []
    record_deadlock(found, verdict(20.0000008, 6.0000004, "margin"))
    (stand,) = found
    assert (stand["from"], stand["seconds"], stand["reason"]) == (14.0, 6.0, "margin"), "to a millionth of a second"
    found.clear()
    for time, stationary_for in ((6.0, 6.0), (6.001, 6.0), (20.0000008, 6.0000004), (20.5, 6.5), (21.0, 6.5)):
        record_deadlock(found, verdict(time, stationary_for, "margin"))
    assert [(stand["from"], stand["seconds"]) for stand in found] == [
        (0.0, 6.0),
        (0.001, 6.0),
        (14.0, 6.5),
        (14.5, 6.5),
    ]
