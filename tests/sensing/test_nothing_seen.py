"""An empty world is believed only where a sensor looked, whatever clocks, restarts and sources do."""

import warnings
from collections.abc import Sequence
from dataclasses import replace
from math import pi

import numpy as np
import pytest
from tests.safety import node_steps
from tests.safety.node_steps import latent_at, surroundings

from safedpa.bus import SURROUNDINGS, ScanMessage, StateMessage, SurroundingsMessage
from safedpa.bus.messages.messages import ActionMessage
from safedpa.dynamics import PhysicsModel, load_model
from safedpa.dynamics.model_file import parse_model, write_model
from safedpa.perception import PerceptionNode
from safedpa.perception.occlusion import OcclusionMap
from safedpa.perception.odometry import OdometryBuffer
from safedpa.perception.surroundings import cover_with_fewer_discs
from safedpa.runtime.node import SafetyFilterNode
from safedpa.runtime.scene import scene_of
from safedpa.safety.defaults import margin_for, settings_named
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene
from safedpa_sim.sensing import Laser, LaserSettings
from safedpa_sim.sensing.sensor_inputs import SimulatedSensors

MODEL, SETTINGS = load_model("car"), settings_named("car")
PILLAR = Scene(0, None, (-3.0, 4.0, -3.0, 3.0), ((1.2, 0.0, 0.3),), (0.0, 0.0, 0.0))


def car(latency: float = 0.05) -> CarRobot:
    return CarRobot(PILLAR, sensor_inputs=SimulatedSensors((Laser(LaserSettings(latency=latency), 1),)))


def asked(node: SafetyFilterNode, state: StateMessage, seen: SurroundingsMessage, model: PhysicsModel = MODEL):
    return node_steps.asked(node, state, latent_at(state, model), seen=seen)


def seen_by(node: PerceptionNode, robot: CarRobot) -> tuple[StateMessage, SurroundingsMessage]:
    state = robot.state_message()
    for scan in robot.scans():
        node.hear("r", scan)
    message = node.step("r", state, {})[SURROUNDINGS]
    assert isinstance(message, SurroundingsMessage)
    return state, message


@pytest.mark.parametrize("latency", [0.05, 0.15, 0.2, 0.3, 0.4])
def test_a_late_laser_is_looked_at_all_the_same(latency: float) -> None:
    robot, node, safe = car(latency), PerceptionNode(), SafetyFilterNode(MODEL, SETTINGS, margin_for(MODEL))
    blind = 0
    for tick in range(60):
        state, message = seen_by(node, robot)
        blind += not message.problems and not (message.points or message.movers or message.hidden)
        action = asked(safe, state, message).action
        robot.receive(ActionMessage(epoch=1, tick=tick, robot_time=0.0, publish_time=0.0, values=action))
        robot.advance()
    assert blind == 0
    assert robot.collisions == []


@pytest.mark.parametrize("latency", [0.05, 0.3])
def test_perception_that_restarts_mid_drive_reports_that_it_has_not_looked_yet(latency: float) -> None:
    robot, node = car(latency), PerceptionNode()
    for tick in range(60):
        if tick == 21:
            node.rescue("r", robot.state_message(), "a fault")
        _, message = seen_by(node, robot)
        assert message.problems or message.points or message.movers or message.hidden
        assert tick != 21 or message.problems
        robot.advance()


def test_sources_that_vanish_leave_no_empty_world() -> None:
    state = replace(car().state_message(), values=(0.0, 0.0, 0.0, 1.0))
    node = SafetyFilterNode(MODEL, SETTINGS, margin_for(MODEL), limits=None)
    wall = tuple((0.8, 0.1 * k, 0.05) for k in range(-5, 6))
    assert asked(node, state, surroundings(state, points=wall)).status == "violated"
    gone = replace(state, tick=state.tick + 1, robot_time=state.robot_time + state.period, sources=())
    verdict = asked(node, gone, surroundings(gone))
    assert (verdict.status, verdict.action) == ("fallback", (0.0, 0.0))
    assert "no longer named" in verdict.sentence
    again = replace(gone, epoch=2, tick=0, obstacles=())
    assert asked(node, again, surroundings(again)).status == "passed", "a restarted robot may have none"


@pytest.mark.parametrize(
    ("wrong", "notice"),
    [
        ({"ages": (-1.0,)}, "old"),
        ({"ages": (9.0,)}, "old"),
        ({"ages": (-5.0,)}, "old"),
        ({"epoch": 77}, "another moment"),
        ({"tick": 500}, "another moment"),
        ({"ages": (0.05, 0.05)}, "ages"),
        ({"points": tuple((3.0, 0.1 * k, 0.05) for k in range(100)), "movers": ((np.nan,) * 6,)}, "NaN"),
    ],
)
def test_surroundings_that_cannot_be_of_this_moment_brake_the_robot(wrong: dict[str, object], notice: str) -> None:
    state = replace(car().state_message(), values=(0.0, 0.0, 0.0, 1.0))
    node = SafetyFilterNode(MODEL, SETTINGS, margin_for(MODEL))
    seen = replace(surroundings(state), **wrong)  # type: ignore[arg-type]
    verdict = asked(node, state, seen)
    assert (verdict.status, verdict.action) == ("fallback", (-0.6, 0.0)), "as hard as it can, at 1 m/s"
    assert notice in verdict.sentence


@pytest.mark.parametrize("until_action", [0.0, 0.1])
@pytest.mark.parametrize("wrong", [{"movers": ((0.9, 0, 1, 0, 0, -9.0),)}, {"hidden": ((0.9, 0, 1, -9.0),)}])
def test_a_mover_slower_than_at_rest_brakes_the_robot(wrong: dict[str, object], until_action: float) -> None:
    """Such a speed reduces the radius: a person in front of the car would be far from it."""
    state = replace(car().state_message(), values=(0.0, 0.0, 0.0, 1.0), until_action=until_action)
    verdict = asked(SafetyFilterNode(MODEL, SETTINGS, margin_for(MODEL)), state, surroundings(state, **wrong))
    assert (verdict.status, verdict.action) == ("fallback", (-0.6, 0.0))
    assert "speed below 0" in verdict.sentence


def test_a_speed_that_stays_whatever_is_done_does_not_drive_the_car_backwards() -> None:
    """The reported speed is wrong: hard braking would reverse for ever, and no sensor looks there."""
    state = replace(car().state_message(), values=(0.0, 0.0, 0.0, 1.0))
    node = SafetyFilterNode(MODEL, SETTINGS, margin_for(MODEL))
    commands = []
    for _ in range(60):
        verdict = asked(node, state, surroundings(state, problems=("the source laser is frozen",)))
        commands.append(verdict.action[0])
        state = replace(
            state, tick=state.tick + 1, robot_time=state.robot_time + state.period, applied=tuple(verdict.action)
        )
    assert commands[0] == -0.6
    assert sum(command < 0.0 for command in commands) * state.period < 1.2
    assert set(commands[-20:]) == {0.0}


@pytest.mark.parametrize("until_action", [0.0, 0.05])
@pytest.mark.parametrize("wrong", [{"movers": ((3.0, 2.0, 0.1),)}, {"hidden": ((3.0, 2.0),)}])
def test_rows_of_a_wrong_width_are_reported_however_late_the_action_acts(wrong: dict[str, object], until_action: float):
    state = replace(car().state_message(), values=(0.0, 0.0, 0.0, 1.0), until_action=until_action)
    verdict = asked(SafetyFilterNode(MODEL, SETTINGS, margin_for(MODEL)), state, surroundings(state, **wrong))
    assert (verdict.status, verdict.action) == ("fallback", (-0.6, 0.0))
    assert "rows of other lengths" in verdict.sentence


def commands_while_reported(state: StateMessage, speeds: Sequence[float], every: int = 1, applied: bool = True):
    """The commands while the laser is lost and these speeds are reported; one tick in ``every`` comes."""
    node, commands = SafetyFilterNode(MODEL, SETTINGS, margin_for(MODEL), limits=None), []
    for speed in speeds:
        state = replace(state, values=(0.0, 0.0, 0.0, speed))
        action = asked(node, state, surroundings(state, problems=("the source laser is frozen",))).action
        commands.append(action[0])
        state = replace(
            state,
            tick=state.tick + every,
            robot_time=state.robot_time + every * state.period,
            applied=tuple(action) if applied else (),
        )
    return commands


@pytest.mark.parametrize("reported", [0.03, 0.09, -0.09, 0.101])
def test_a_speed_that_is_a_little_wrong_at_rest_does_not_make_the_car_creep(reported: float) -> None:
    commands = commands_while_reported(car().state_message(), [reported] * 120)
    assert set(commands[-40:]) == {0.0}


def test_lost_ticks_speeds_or_reports_of_applied_actions_begin_no_braking_that_drives_backwards() -> None:
    commands = commands_while_reported(car().state_message(), [1.0] * 60, applied=False)
    assert commands[0] == -0.6
    assert set(commands[-20:]) == {0.0}
    state = car().state_message()
    commands = commands_while_reported(state, [1.0] * 20, every=5)
    assert 5 * state.period * sum(command < 0.0 for command in commands) < 1.2 + 5 * state.period
    commands = commands_while_reported(car().state_message(), [np.nan if k % 20 == 19 else 1.0 for k in range(80)])
    assert set(commands[-20:]) == {0.0}


def test_a_new_model_begins_no_new_braking() -> None:
    state = replace(car().state_message(), values=(0.0, 0.0, 0.0, 1.0))
    old = scene_of(MODEL, SETTINGS)
    for tick in range(60):
        old.follow(replace(state, tick=tick, applied=(-0.6, 0.0)))
    new = scene_of(MODEL, SETTINGS)
    new.remember(old)
    new.follow(replace(state, tick=60, applied=(-0.6, 0.0)))
    assert old.backup is not None
    assert new.backup is not None
    assert list(old.backup(np.array(state.values))) == list(new.backup(np.array(state.values))) == [0.0, 0.0]


def test_a_car_that_follows_its_commands_may_brake_hard_again() -> None:
    scene, state = scene_of(MODEL, SETTINGS), car().state_message()
    reported = [(1.0, -0.6)] * 60 + [(0.0, 0.0)] * 10 + [(0.3, 1.0), (0.5, 1.0)]
    hardest = []
    for tick, (speed, command) in enumerate(reported):
        scene.follow(replace(state, tick=tick, values=(0.0, 0.0, 0.0, speed), applied=(command, 0.0)))
        assert scene.backup is not None
        hardest.append(float(np.asarray(scene.backup(np.array((0.0, 0.0, 0.0, 1.0))))[0]))
    assert hardest[59] == hardest[69] == 0.0
    assert hardest[0] == hardest[-1] == -0.6


def test_obstacles_of_a_robot_with_sources_are_not_dropped_in_silence() -> None:
    state = replace(car().state_message(), obstacles=((0.9, 0.0, 0.2),), values=(0.0, 0.0, 0.0, 1.0))
    node = SafetyFilterNode(MODEL, SETTINGS, margin_for(MODEL))
    verdict = asked(node, state, surroundings(state))
    assert verdict.status == "fallback"
    assert "next to sensor sources" in verdict.sentence


def test_a_mover_ahead_of_a_stationary_car_counts_though_a_wall_is_nearer() -> None:
    """64 points at the side have less h at rest; driving off, the mover has."""
    state = replace(car().state_message(), values=(0.0, 0.0, 0.0, 0.0))
    wall = tuple((0.02 * k - 0.3, 0.42, 0.05) for k in range(64))
    for ahead in (0.8, 0.9, 1.05):
        node = SafetyFilterNode(MODEL, SETTINGS, margin_for(MODEL))
        mover = ((ahead, 0.0, 0.05, 0.0, 0.0, 1.5),)
        alone = asked(node, state, surroundings(state, movers=mover))
        node = SafetyFilterNode(MODEL, SETTINGS, margin_for(MODEL))
        both = asked(node, state, surroundings(state, movers=mover, points=wall))
        assert both.action[0] <= alone.action[0] + 1e-6


def test_what_may_move_is_wider_where_the_action_acts_late_or_the_actuators_are_slow() -> None:
    state = replace(car().state_message(), values=(0.0, 0.0, 0.0, 0.5))
    heights = []
    for until_action in (0.0, 0.1, 0.2):
        late = replace(state, until_action=until_action)
        node = SafetyFilterNode(MODEL, SETTINGS, margin_for(MODEL))
        heights.append(asked(node, late, surroundings(late, movers=((1.8, 0.0, 0.05, 0.0, 0.0, 1.5),))).h_now)
    assert heights[0] - heights[1] >= 0.1 * 1.5 - 1e-6
    assert heights[0] - heights[2] >= 0.2 * 1.5 - 1e-6
    # The model knows a dead time: until an action acts, people go on walking.
    state, heights = replace(car().state_message(), values=(0.0, 0.0, 0.0, 0.0)), []
    for delay in (0.0, 0.2):
        model = load_model("car")
        if delay:
            model = parse_model(write_model(model) + f'\n[[effects]]\nname = "actuator_delay"\nseconds = {delay}\n')
        node = SafetyFilterNode(model, SETTINGS)
        seen = surroundings(state, movers=((1.2, 0.0, 0.05, 0.0, 0.0, 1.5),))
        heights.append(asked(node, state, seen, model).h_now)
    assert heights[0] - heights[1] >= 0.2 * 1.5 - 1e-6


@pytest.mark.parametrize("leap", [-0.1, -0.5, 60.0])
def test_after_a_leap_of_the_clock_nothing_of_before_is_believed(leap: float) -> None:
    robot, node = car(), PerceptionNode()
    for _ in range(40):
        state, _ = seen_by(node, robot)
        robot.advance()
    leapt = replace(robot.state_message(), robot_time=state.robot_time + leap)
    message = node.step("r", leapt, {})[SURROUNDINGS]
    assert isinstance(message, SurroundingsMessage)
    assert message.problems


PERIOD = 0.05
RAYS = 360


def state_of(tick: int, yaw: float = 0.0, epoch: int = 1, robot_time: float | None = None) -> StateMessage:
    return StateMessage(
        epoch=epoch, tick=tick, robot_time=tick * PERIOD if robot_time is None else robot_time, publish_time=0.0,
        values=(0.0, 0.0, yaw, 0.0), applied=(0.0, 0.0), applied_by="filter", period=PERIOD, lockstep=True, goal=(),
        obstacles=(), field=(), footprint=(0.2, 0.2, 0.15), sources=("laser",),
    )  # fmt: skip


def scan_of(number: int, time: float, tick: int, yaw: float = 0.0, epoch: int = 1) -> ScanMessage:
    """Of a round wall at 3 m, and a post of 0.2 m radius at (1.5, 0)."""
    angles = yaw + 2.0 * pi / RAYS * np.arange(RAYS)
    along, across = 1.5 * np.cos(angles), 1.5 * np.sin(angles)
    hits = (np.abs(across) < 0.2) & (along > 0.0)
    near = along - np.sqrt(np.where(hits, 0.2**2 - across**2, 0.0))
    noise = np.random.default_rng(number).normal(0.0, 0.003, RAYS)
    return ScanMessage(
        epoch=epoch, tick=tick, robot_time=time, publish_time=0.0, source="laser", mount=(0.0, 0.0, 0.0),
        first_angle=0.0, angle_step=2.0 * pi / RAYS, ranges=tuple((np.where(hits, near, 3.0) + noise).tolist()),
        nearest=0.02, farthest=8.0, number=number,
    )  # fmt: skip


def step(node: PerceptionNode, state: StateMessage) -> SurroundingsMessage:
    message = node.step("r", state, {})[SURROUNDINGS]
    assert isinstance(message, SurroundingsMessage)
    return message


def test_headings_that_wrap_are_laid_the_short_way_round_and_a_repeated_tick_breaks_nothing() -> None:
    odometry = OdometryBuffer()
    odometry.add(0.0, (0.0, 0.0, pi - 0.01))
    odometry.add(0.1, (1.0, 0.0, -pi + 0.03))
    found = odometry.at(0.05)
    assert found is not None
    assert found == pytest.approx((0.5, 0.0, pi + 0.01))
    odometry = OdometryBuffer()
    odometry.add(1.0, (0.0, 0.0, 0.0))
    odometry.add(1.0, (1.0, 0.0, 0.0))
    assert odometry.at(1.0 + 5e-10) == (1.0, 0.0, 0.0)


def test_a_robot_that_heads_west_with_a_wrapped_heading_is_believed() -> None:
    """As a ROS gateway reports it: the heading comes from a quaternion."""
    node = PerceptionNode()
    for tick in range(60):
        true = pi + 0.02 * (1 if tick % 2 else -1)
        if tick:
            node.hear("r", scan_of(tick, (tick - 0.5) * PERIOD, tick - 1, yaw=pi))
        message = step(node, state_of(tick, yaw=float(np.arctan2(np.sin(true), np.cos(true)))))
        if tick > 10:
            assert not message.problems
            assert min(np.hypot(x - 1.5, y) - radius for x, y, radius in message.points) < 0.25
            assert min(np.hypot(x + 1.5, y) - radius for x, y, radius in message.points) > 1.0


@pytest.mark.parametrize(
    ("ahead", "reports_tick"), [(0.3, True), (3.0, True), (100.0, True), (3.0, False), (100.0, False)]
)
def test_a_source_whose_clock_runs_ahead_is_not_believed_when_the_robots_clock_comes_there(ahead, reports_tick):
    node = PerceptionNode()
    for tick in range(120):
        time = tick * PERIOD + 0.01 + ahead
        node.hear("r", scan_of(tick, time, tick if reports_tick else int(time / PERIOD)))
        message = step(node, state_of(tick + 1))
        assert message.ages == (-1.0,)
    assert message.problems == (
        f"the source laser sends scans {ahead - PERIOD + 0.01:.2f} s ahead of the robot's clock",
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


def test_scans_between_states_wait_for_the_state_after_them_even_of_the_next_epoch() -> None:
    node = PerceptionNode()
    step(node, state_of(0))
    step(node, state_of(1))
    node.hear("r", scan_of(0, 2.4 * PERIOD, 2))
    assert step(node, state_of(2)).ages == (-1.0,)
    assert step(node, state_of(3)).ages == pytest.approx((0.6 * PERIOD,))
    node = PerceptionNode()
    step(node, state_of(40))
    node.hear("r", scan_of(0, 0.0, 0, epoch=2))
    node.hear("r", scan_of(7, 2.02, 40))
    assert step(node, state_of(41)).scans == ((0.0, 7.0),)
    state = state_of(0, epoch=2)
    node.hear("r", replace(scan_of(1, 0.0, 0, epoch=2), source="another"))
    assert step(node, state).scans == ((0.0, 0.0),)


def test_a_late_scan_forgets_no_person_who_went_out_of_sight_since() -> None:
    hiding, none, all_of_it = OcclusionMap(31, 0.2, 1.5), np.zeros((31, 31), bool), np.ones((31, 31), bool)
    hiding.look(0.9, all_of_it, none, none, none)
    person = none.copy()
    person[15, 15] = True
    alongside = all_of_it.copy()
    alongside[10:21, 10:21] = False
    hiding.look(1.0, alongside, none, none, person)  # the newer one sees him, and nothing around him
    hiding.look(0.8, all_of_it, none, none, none)  # the other was there before him
    for time in (0.93, 1.06):
        hiding.wait(time)
    hiding.look(1.1, alongside, none, none, none)
    assert hiding.present[15, 15]
    hiding.look(1.2, all_of_it, none, none, none)
    hiding.look(1.3, alongside, none, none, none)
    assert not hiding.present[15, 15], "a look that is newer than he is rules him out"


@pytest.mark.parametrize("most", [7, 8, 12, 20])
def test_around_the_origin_the_allowed_number_of_discs_covers_everything(most: int) -> None:
    places = np.random.default_rng(0).uniform(-15.0, 15.0, (3000, 2))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = cover_with_fewer_discs(places, np.full(len(places), 0.05), np.array((0.01, 0.02)), most)
    assert len(found) <= most
    apart = np.hypot(places[:, None, 0] - found[:, 0], places[:, None, 1] - found[:, 1])
    assert ((apart + 0.05 - found[:, 2]).min(axis=1) < 1e-9).all()


@pytest.mark.parametrize("gap", [1 / 40, 1 / 30, 0.05, 0.06, 0.07, 0.09, 0.1, 0.12])
@pytest.mark.parametrize("way", [(1, 0), (2, 1), (1, 1)])
def test_the_front_of_hidden_people_moves_at_their_top_speed_whatever_the_rate_of_scans(gap, way):
    """But for the cell that it is in, and 3 % of the way: it goes from cell to cell."""
    hiding, none, alongside = OcclusionMap(101, 0.2, 1.5), np.zeros((101, 101), bool), np.ones((101, 101), bool)
    alongside[50, 50] = False
    hiding.look(0.0, alongside, none, none, none)
    for look in range(1, int(1.2 / gap) + 1):
        hiding.look(look * gap, none, none, none, none)
        reached = max(n for n in range(25) if hiding.present[50 + n * way[0], 50 + n * way[1]])
        gone = 0.1 * float(np.hypot(*way))
        assert 1.5 * look * gap - reached * gone < gone + 0.03 * 1.5 * look * gap + 1e-9
