"""The simulated car without a bus: determinism, watchdog, goals, collisions, command delays, action guard."""

from dataclasses import replace
from math import hypot, inf, nan, pi, sin

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safedpa.bus.messages.codec import decode, encode
from safedpa.bus.messages.messages import ActionMessage, StateMessage
from safedpa.errors import InputError
from safedpa_sim.robots import BRAKE, LOADS, ActionGuard, CarRobot, Scene, footprint
from safedpa_sim.robots.car.robot import DelayedCommands

FIELD = (-4.0, 4.0, -4.0, 4.0)
LOAD_NAMES = ("none", *LOADS)


def scene(load: str = "none", start: tuple[float, float, float] = (0.0, 0.0, 0.0), **fields) -> Scene:
    return Scene(0, LOADS.get(load), FIELD, fields.pop("obstacles", ()), start, fixed_goals=((3.0, 3.0),), **fields)


def drive(robot: CarRobot, values: tuple[float, float], ticks: int) -> CarRobot:
    for _ in range(ticks):
        message = ActionMessage(epoch=1, tick=robot.tick, robot_time=0.0, publish_time=0.0, values=values)
        assert robot.receive(message) is None
        robot.advance()
    return robot


@pytest.mark.parametrize("load", LOAD_NAMES)
def test_the_same_seed_and_actions_give_bit_equal_states(load):
    def run() -> tuple[list[tuple[float, ...]], str]:
        robot, states = CarRobot(Scene.random(7, load)), []
        for step in range(300):
            drive(robot, (1.2 + 0.7 * sin(0.05 * step), 0.34 * sin(0.13 * step)), 1)
            states.append(robot.values)
        return states, robot.trajectory_hash

    first, second = run(), run()
    assert first == second


def test_other_periods_give_the_same_physics_and_another_action_gives_another_hash():
    assert (
        drive(CarRobot(scene()), (1.0, 0.0), 5).trajectory_hash
        != drive(CarRobot(scene()), (1.0, 0.1), 5).trajectory_hash
    )
    coarse, fine = CarRobot(scene(), period=0.1), CarRobot(scene(), period=0.01)
    drive(coarse, (1.5, 0.2), 20)
    drive(fine, (1.5, 0.2), 200)
    assert coarse.values == pytest.approx(fine.values, abs=1e-9)
    with pytest.raises(InputError, match="period"):
        CarRobot(scene(), period=0.0)


@pytest.mark.parametrize("load", LOAD_NAMES)
def test_without_actions_the_watchdog_brings_the_robot_to_rest(load):
    robot = drive(CarRobot(scene(load, (-3.0, 0.0, 0.0))), (2.0, 0.0), 40)
    assert robot.values[3] > 1.3
    for _ in range(60):
        robot.advance()
    state = robot.state_message()
    assert abs(state.values[3]) < 1e-3
    assert (state.applied, state.applied_by) == ((0.0, 0.0), "watchdog")
    assert robot.watchdog_ticks == 60


@pytest.mark.parametrize(("heading", "wall"), [(0.0, "east"), (pi / 2, "north"), (pi, "west"), (-pi / 2, "south")])
def test_driving_into_a_wall_is_one_collision_with_that_wall(heading, wall):
    robot = drive(CarRobot(scene(start=(0.0, 0.0, heading))), (1.5, 0.0), 200)
    (collision,) = robot.collisions
    assert (collision.part, collision.what) == ("car", f"wall {wall}")
    assert collision.speed > 1.2
    assert robot.state_message().collisions == 1
    x, y, _, _ = robot.values
    assert max(abs(x), abs(y)) + 0.40 < 4.01, "it does not go through"
    assert f"car against wall {wall}" in str(collision)


def test_obstacles_that_are_hit_are_named_and_counted_also_by_the_load_but_not_those_passed_close_by():
    robot = CarRobot(scene(obstacles=((2.0, 3.0, 0.3), (1.5, 0.0, 0.3))))
    drive(robot, (1.0, 0.0), 80)
    assert [collision.what for collision in robot.collisions] == ["obstacle 1"]
    drive(robot, (-0.5, 0.0), 60)
    drive(robot, (1.0, 0.0), 80)
    assert [collision.what for collision in robot.collisions] == ["obstacle 1", "obstacle 1"], "a second contact counts"
    # The car passes, but the load cuts the corner and is wider.
    robot = CarRobot(scene("large_chair", obstacles=((1.0, 0.40, 0.22),)))
    drive(robot, (1.0, 0.0), 100)
    assert [(collision.part, collision.what) for collision in robot.collisions] == [("load", "obstacle 0")]
    radius = footprint(None)[2]
    robot = CarRobot(scene(obstacles=((1.0, 0.3 + radius + 0.005, 0.3),)))
    assert drive(robot, (1.0, 0.0), 60).collisions == []


def test_a_goal_counts_when_the_rear_axle_is_near_and_the_next_one_follows():
    robot = CarRobot(replace(scene(), fixed_goals=((1.0, 0.0), (3.0, 2.0))))
    while robot.goals_reached == 0:
        x, y, _, _ = robot.values
        assert hypot(1.0 - x, y) >= 0.3
        assert robot.goal == (1.0, 0.0)
        drive(robot, (1.0, 0.0), 1)
    assert robot.goal == (3.0, 2.0)


def test_the_state_message_says_what_the_robot_knows_and_survives_the_codec():
    robot = CarRobot(Scene.random(2, "box"), 0.05, True, epoch=77, wall_clock=lambda: 12.5)
    first = robot.state_message()
    assert (first.epoch, first.tick, first.applied_by, first.publish_time) == (77, 0, "none", 12.5)
    assert first.footprint == footprint(LOADS["box"])
    assert len(first.obstacles) == 6
    assert len(first.load_pose) == 5
    robot.advance()
    second = robot.state_message()
    assert (second.tick, second.robot_time) == (1, 0.05)
    assert decode(StateMessage, encode(second)) == second


def test_unhitching_shrinks_the_footprint_and_hitching_grows_it():
    robot = drive(CarRobot(scene("chair")), (1.0, 0.0), 20)
    robot.unhitch()
    assert robot.state_message().footprint == footprint(None)
    assert robot.state_message().load_pose == ()
    robot.hitch(LOADS["box"])
    assert robot.state_message().footprint == footprint(LOADS["box"])


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


def felt(late: DelayedCommands, *commands: tuple[float, float]) -> list[tuple[float, float, float]]:
    return [(drive, steer, round(seconds, 9)) for each in commands for drive, steer, seconds in late.felt(each, 0.05)]


def test_commands_come_whole_periods_or_a_part_of_one_late_each_channel_by_its_own_delay() -> None:
    assert felt(DelayedCommands(0.0, 0.0), (1.0, 0.1), (2.0, 0.2)) == [(1.0, 0.1, 0.05), (2.0, 0.2, 0.05)]
    found = felt(DelayedCommands(0.1, 0.1), (1.0, 0.1), (2.0, 0.2), (0.5, 0.3), (0.0, 0.0))
    assert found == [(0.0, 0.0, 0.05), (0.0, 0.0, 0.05), (1.0, 0.1, 0.05), (2.0, 0.2, 0.05)]
    found = felt(DelayedCommands(0.02, 0.02), (1.0, 0.1), (2.0, 0.2))
    assert found == [(0.0, 0.0, 0.02), (1.0, 0.1, 0.03), (1.0, 0.1, 0.02), (2.0, 0.2, 0.03)]
    found = felt(DelayedCommands(0.01, 0.05), (1.0, 0.1), (2.0, 0.2))
    assert found == [(0.0, 0.0, 0.01), (1.0, 0.0, 0.04), (1.0, 0.1, 0.01), (2.0, 0.1, 0.04)]


def test_periods_add_up_for_a_long_time() -> None:
    late = DelayedCommands(0.13, 0.07)
    for tick in range(2000):
        parts = list(late.felt((float(tick), -float(tick)), 0.05))
        assert sum(seconds for _, _, seconds in parts) == pytest.approx(0.05)
    assert parts[-1][0] == 1997.0
    assert parts[-1][1] == -1998.0


@pytest.mark.parametrize("seconds", [-0.1, nan, inf])
def test_a_delay_is_a_number_of_seconds(seconds: float) -> None:
    with pytest.raises(InputError, match=r"steer_seconds: got .*, wanted a finite number of seconds, 0 or more"):
        DelayedCommands(0.0, seconds)


@pytest.mark.parametrize("load", LOAD_NAMES)
def test_a_car_describes_its_scene(load: str) -> None:
    """The setup of a recording has it, so that the drive can be made again."""
    assert CarRobot(replace(scene(load), seed=7)).about == {"seed": 7, "load": load}
