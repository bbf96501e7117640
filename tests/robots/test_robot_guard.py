"""The last gate: it refuses everything that is not this tick's action within limits, and brakes instead."""

from __future__ import annotations

from math import inf, nan

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safedpa.bus.wire.messages import ActionMessage
from safedpa_sim.robots import BRAKE, ActionGuard, CarRobot, Scene

LOW, HIGH = (-0.6, -0.34), (2.0, 0.34)


def action(values: tuple[float, ...] = (1.0, 0.1), tick: int = 0, epoch: int = 1) -> ActionMessage:
    return ActionMessage(epoch=epoch, tick=tick, robot_time=0.0, publish_time=0.0, values=values)


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (action(epoch=2), "wrong epoch"),
        (action(tick=4), "late"),
        (action(tick=6), "from the future"),
        (action((1.0,), tick=5), "wrong length"),
        (action((1.0, 0.1, 0.0), tick=5), "wrong length"),
        (action((), tick=5), "wrong length"),
        (action((nan, 0.0), tick=5), "not finite"),
        (action((1.0, -inf), tick=5), "not finite"),
        (action((2.0 + 1e-6, 0.0), tick=5), "out of range"),
        (action((-0.6 - 1e-6, 0.0), tick=5), "out of range"),
        (action((1.0, 0.34 + 1e-6), tick=5), "out of range"),
        (action((1.0, -0.34 - 1e-6), tick=5), "out of range"),
    ],
)
def test_each_fault_has_its_reason_and_its_counter(message, reason):
    guard = ActionGuard(1, LOW, HIGH)
    guard.begin(5)
    assert guard.offer(message) == reason
    assert guard.accepted is None
    assert guard.refusals == {reason: 1}
    assert guard.offer(action(tick=5)) is None, "a refused message does not block a right one"


@pytest.mark.parametrize("values", [LOW, HIGH, (2.0 + 1e-12, 0.0), (0.0, 0.0), (1, 0)])
def test_limits_themselves_are_accepted_unchanged(values):
    guard = ActionGuard(1, LOW, HIGH)
    assert guard.offer(action(values)) is None
    assert guard.accepted == values


def test_the_first_action_of_a_tick_stays():
    guard = ActionGuard(1, LOW, HIGH)
    assert guard.offer(action((1.0, 0.0))) is None
    assert guard.offer(action((0.5, 0.0))) == "repeated"
    assert guard.accepted == (1.0, 0.0)
    guard.begin(1)
    assert guard.accepted is None
    assert guard.offer(action((0.5, 0.0))) == "late"


numbers = st.one_of(st.floats(-3, 3), st.just(nan), st.just(inf), st.sampled_from([-0.6, 2.0, 0.34, -0.34, 0.0]))
messages = st.builds(
    action,
    st.lists(numbers, min_size=1, max_size=3).map(tuple) | st.just((1.0, 0.1)),
    tick=st.integers(0, 8),
    epoch=st.sampled_from([1, 1, 1, 2]),
)
SCENE = Scene.random(0)


@settings(max_examples=150, deadline=None)
@given(st.lists(st.lists(messages, max_size=4), min_size=1, max_size=8))
def test_whatever_arrives_only_valid_actions_act_and_otherwise_the_robot_brakes(periods):
    robot = CarRobot(SCENE, period=0.0025)
    for tick, arriving in enumerate(periods):
        accepted = [message for message in arriving if robot.receive(message) is None]
        valid = [
            message.values
            for message in arriving
            if message.epoch == 1
            and message.tick == tick
            and len(message.values) == 2
            and -0.6 <= message.values[0] <= 2.0
            and -0.34 <= message.values[1] <= 0.34
        ]
        assert len(accepted) == min(1, len(valid))
        robot.advance()
        state = robot.state_message()
        assert state.tick == tick + 1
        assert (state.applied, state.applied_by) == ((valid[0], "filter") if valid else (BRAKE, "watchdog"))
    assert sum(robot.guard.refusals.values()) + robot.tick - robot.watchdog_ticks == sum(map(len, periods))
