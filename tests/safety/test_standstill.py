"""A robot that stands though something is wished is noticed, with a reason, whatever robot it is."""

from __future__ import annotations

import pytest

from safedpa.bus import VerdictMessage
from safedpa.robots.car.system import CAR
from safedpa.robots.pendulum.system import PENDULUM
from safedpa.robots.point.system import POINT
from safedpa.safety.standstill import Stand, Standstill, note_standstill, places_of
from safedpa.systems import System, Variable

PERIOD = 0.05


def stood(seconds: float, wished: float, driven: float, creep: float = 0.0, noise: float = 0.0) -> Standstill:
    """After so long at one place; metres a tick that the model promised under the wish and under the action."""
    standing, x = Standstill((0, 1)), 1.0
    for tick in range(round(seconds / PERIOD) + 1):
        here = (x + noise * (tick % 2), 0.0, 0.3)
        standing.measure(here, PERIOD)
        standing.promise(here, (here[0] + wished, 0.0, 0.0), (here[0] + driven, 0.0, 0.0))
        x += creep
    return standing


def test_who_stands_while_something_is_wished_is_counted_and_told_after_five_seconds() -> None:
    assert stood(4.9, 0.005, 0.0).reason("corrected", ("obstacle 0",), False) == ""
    later = stood(6.0, 0.005, 0.0)
    assert later.seconds == pytest.approx(6.0)
    told = later.reason("corrected", ("obstacle 0", "left wall"), False)
    assert told.startswith("boxed in: obstacle 0 and left wall")
    assert later.reason("relaxed", ("obstacle 0",), False).startswith("margin: obstacle 0")
    assert later.reason("corrected", ("obstacle 0",), True).startswith("margin")
    assert later.reason("fallback", (), False).startswith("no decision")


def test_an_action_that_should_move_it_and_does_not_lies_in_the_dead_band() -> None:
    standing = stood(6.0, 0.005, 0.001)
    assert standing.reason("corrected", ("obstacle 0",), False).startswith("dead band")
    assert standing.failed == pytest.approx(0.001)
    assert standing.would_fail(0.0009)
    assert not standing.would_fail(0.002), "a stronger action was not tried"
    assert stood(0.3, 0.005, 0.001).failed == 0.0, "it takes half a second to see"


def test_noise_and_creeping_are_standing_but_driving_is_not() -> None:
    assert stood(6.0, 0.005, 0.001, creep=2e-5).seconds > 5.0
    assert stood(6.0, 0.005, 0.001, noise=1e-4).seconds > 5.0
    assert stood(6.0, 0.005, 0.004, creep=0.004).seconds == 0.0
    assert stood(6.0, 0.0, 0.0).seconds == 0.0, "nothing is wished"


def test_moving_again_and_wishing_nothing_end_a_stand() -> None:
    standing = stood(6.0, 0.005, 0.001)
    standing.measure((1.5, 0.0, 0.0), PERIOD)
    assert (standing.seconds, standing.failed) == (0.0, 0.0)
    standing = stood(6.0, 0.005, 0.001)
    standing.interrupted()
    standing.measure((1.0, 0.0, 0.3), PERIOD)
    assert standing.seconds == 0.0


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_the_unit_of_length_does_not_matter(unit: float) -> None:
    standing = Standstill((0,))
    for _ in range(121):
        standing.measure((unit,), PERIOD)
        standing.promise((unit,), (1.005 * unit,), (1.001 * unit,))
    assert standing.seconds == pytest.approx(6.0)
    assert standing.reason("corrected", ("wall",), False).startswith("dead band")


def test_places_are_positions_or_what_is_no_rate() -> None:
    assert places_of(CAR) == (0, 1)
    assert places_of(POINT) == (0, 1)
    assert places_of(PENDULUM) == (0,)
    tank = System("tank", (Variable("level", "%", 0.0, 1.0), Variable("inflow", "%/s", 0.0, 1.0)), ())
    assert places_of(tank) == (0,)


def verdict(time: float, stands: float, why: str) -> VerdictMessage:
    return VerdictMessage(
        epoch=1, tick=round(time / PERIOD), robot_time=time, publish_time=0.0, status="corrected", sentence="",
        action=(), wish=(), slack=0.0, active=(), h_now=0.0, h_next=0.0, margin=0.0, solver="", microseconds=0.0,
        stands=stands, standstill=why,
    )  # fmt: skip


def test_stands_are_collected_one_by_one_and_the_newest_reason_counts() -> None:
    found: list[Stand] = []
    told = ((3.0, 3.0, ""), (5.05, 5.05, "boxed in"), (5.1, 5.1, "dead band"), (6.0, 0.0, ""), (20.0, 6.0, "margin"))
    for item in told:
        note_standstill(found, verdict(*item))
    assert found == [
        {"from": 0.0, "seconds": 5.1, "reason": "dead band"},
        {"from": 14.0, "seconds": 6.0, "reason": "margin"},
    ]
