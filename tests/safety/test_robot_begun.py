"""What the filter's service takes for known of a robot that it knows little of."""

from __future__ import annotations

from dataclasses import replace

import pytest
from tests.safety.node_steps import ABSENT, CAR, LATE, SETTINGS, asked, latent_at, memory_of, state_at

from safedpa.dynamics import fingerprint
from safedpa.safety.filtered_robot import FilteredRobot
from safedpa.safety.held_model import HeldModel, uncalibrated
from safedpa.safety.node import SafetyFilterNode


def begun() -> FilteredRobot:
    return FilteredRobot.begun(HeldModel(CAR, "m", uncalibrated(SETTINGS, "m")), SETTINGS)


@pytest.mark.parametrize("tick", [1, 2, 3, 40])
def test_a_robot_that_is_met_on_its_way_is_not_held_against_what_was_expected_before(tick: int) -> None:
    """With the margin of before, as after a failure: what it expected was the next tick of another time."""
    robot, here = begun(), (0.0, 0.0, 0.0, 0.5)
    robot.barriers = robot.scene.of(state_at(tick))
    for ticks_later, seen in ((0, False), (1, True), (3, False)):
        robot.margin.expect(here)
        robot.watch_margin(state_at(tick + ticks_later))
        assert bool(robot.margin.seen) is seen


def test_a_robot_with_one_model_waits_for_no_other() -> None:
    assert not any(begun().may_wait(state_at(tick)) for tick in range(60))


def test_of_a_robot_whose_first_action_is_none_nothing_late_is_said() -> None:
    """Its actions are two numbers; what it says was applied is one, from which nothing is learned."""
    node, state = SafetyFilterNode(CAR, SETTINGS), state_at(0, applied=(0.0,))
    verdict = asked(node, state, latent_at(state))
    assert "later than told" not in verdict.sentence
    assert memory_of(node).until_action == 0.0


def test_a_late_robot_with_a_state_of_another_size_is_answered_all_the_same() -> None:
    """What is on its way leads nowhere from there, and the filter says what is wrong."""
    node = SafetyFilterNode(LATE, SETTINGS)
    applied = (0.0, 0.0)
    values = tuple(LATE.latent.tolist())
    for tick in range(3):
        state = state_at(tick, applied=applied)
        latent = replace(latent_at(state), model=fingerprint(LATE), values=values)
        applied = asked(node, state, latent, (1.0, 0.1)).action  # type: ignore[assignment]
    state = state_at(3, (0.0, 0.0, 0.0), applied=applied)
    verdict = asked(node, state, replace(latent, tick=3))
    assert memory_of(node).pending, "something is on its way"
    assert (verdict.status, verdict.predicted) == ("fallback", ())
    assert asked(node, state_at(4, applied=verdict.action), ABSENT).status == "passed"
