"""What changes about the car while it drives: when, how much, and never where it would hit something at once."""

from __future__ import annotations

from math import atan2, hypot, tan

import pytest

from safedpa.bus import ActionMessage
from safedpa.errors import InputError
from safedpa_sim.robots import CHANGES, CarRobot, PlannedChange, Scene

OPEN = Scene(0, None, (-100.0, 100.0, -100.0, 100.0), (), (0.0, 0.0, 0.3), ((50.0, 0.0),))
NARROW = Scene(0, None, (-100.0, 100.0, -0.42, 0.42), (), (0.0, 0.0, 0.0), ((50.0, 0.0),))


def driven(change: str, seconds: float, action: tuple[float, float], scene: Scene = OPEN) -> CarRobot:
    robot = CarRobot(scene, change=PlannedChange(change, 1.0))
    for _ in range(round(seconds / robot.period)):
        state = robot.state_message()
        message = ActionMessage(
            epoch=state.epoch, tick=state.tick, robot_time=state.robot_time, publish_time=0.0, values=action
        )
        assert robot.receive(message) is None
        robot.advance()
    return robot


@pytest.mark.parametrize("change", CHANGES)
def test_it_comes_when_it_is_due_and_once(change: str) -> None:
    before = driven(change, 1.0, (1.5, 0.0))
    after = driven(change, 1.05, (1.5, 0.0))
    assert before.changed_at is None
    assert after.changed_at == 20
    assert driven(change, 3.0, (1.5, 0.0)).changed_at == 20


def test_a_head_wind_takes_its_push_over_the_gain_off_the_speed() -> None:
    calm = driven("steering_offset", 1.0, (1.5, 0.0)).values[3]
    windy = driven("headwind", 4.0, (1.5, 0.0))
    assert windy.values[3] == pytest.approx(calm - 1.0 / windy.world.parameters.servo_gain, abs=0.03)
    assert hypot(*windy.world.wind) == pytest.approx(1.0)
    assert atan2(-windy.world.wind[1], -windy.world.wind[0]) == pytest.approx(0.3, abs=0.02)


def test_a_steering_offset_turns_a_car_that_is_commanded_straight_on() -> None:
    robot = driven("steering_offset", 4.0, (1.0, 0.0))
    earlier = driven("steering_offset", 3.0, (1.0, 0.0))
    rate = robot.values[2] - earlier.values[2]
    assert rate == pytest.approx(robot.values[3] * tan(0.08) / 0.32, rel=0.1)


def test_nothing_is_hitched_to_a_stationary_car_or_without_room() -> None:
    assert driven("hitch", 3.0, (0.0, 0.0)).changed_at is None
    assert driven("hitch", 3.0, (1.0, 0.0), NARROW).changed_at is None
    assert driven("hitch", 3.0, (1.0, 0.0)).world.towed is not None


def test_an_unknown_change_is_refused_with_what_there_is() -> None:
    with pytest.raises(InputError, match="headwind, hitch, steering_offset"):
        PlannedChange("flood", 1.0)
