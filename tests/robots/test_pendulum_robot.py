"""The simulated pendulum, alone and with the real nodes, one of which fails during a swing."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safedpa.adaptation import AdaptationNode
from safedpa.bus import (
    ACTION,
    LATENT,
    NOMINAL,
    VERDICT,
    ActionMessage,
    NominalMessage,
    ReceivedMessage,
    Stale,
    VerdictMessage,
)
from safedpa.dynamics import PhysicsModel, Setting, load_model
from safedpa.errors import InputError
from safedpa.policy import PolicyNode
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety.defaults import settings_named
from safedpa_sim.closed_loop import Tick, drive
from safedpa_sim.robots import PendulumRobot, PendulumWorld, task_named, wind_towards
from safedpa_sim.robots.run_summary import summarise_run

MODEL = load_model("pendulum")


def in_wind(wind: tuple[float, float]) -> PhysicsModel:
    blowing = {"wind.speed": Setting(wind[0]), "wind.upward": Setting(wind[1])}
    return MODEL.with_settings({**MODEL.settings, **blowing})


def reported(robot: PendulumRobot, torque: float, **other: Any) -> ActionMessage:
    stamp = {"epoch": robot.guard.epoch, "tick": robot.tick, **other}
    return ActionMessage(robot_time=0.0, publish_time=0.0, values=(torque,), **stamp)


@settings(max_examples=40, deadline=None)
@given(
    angle=st.floats(-4.0, 7.0),
    direction=st.floats(-180.0, 180.0),
    speed=st.floats(0.0, 5.0),
    torques=st.lists(st.floats(-10.0, 10.0), min_size=1, max_size=20),
)
def test_it_moves_as_the_published_equations_say(angle: float, direction: float, speed: float, torques: list[float]):
    wind = wind_towards(speed, direction)
    world, model = PendulumWorld(angle, wind), in_wind(wind)
    state = np.array((angle, 0.0))
    for torque in torques:
        world.advance(torque, 0.01)
        state = model.step(state, np.array((torque,)))
    assert world.angle == pytest.approx(state[0], abs=1e-3)
    assert world.rate == pytest.approx(state[1], abs=1e-2)


def test_wind_blows_in_the_given_direction_and_energy_is_conserved_without_friction_and_air() -> None:
    assert wind_towards(4.0, 90.0) == pytest.approx((0.0, 4.0), abs=1e-12)
    assert wind_towards(4.0, 180.0) == pytest.approx((-4.0, 0.0), abs=1e-12)
    world = PendulumWorld(0.0, wind_towards(4.0, 180.0))
    world.advance(0.0, 0.1)
    assert world.angle < 0.0
    from safedpa_sim.robots.pendulum.world import PendulumParameters

    world = PendulumWorld(0.5, parameters=PendulumParameters(friction=0.0, drag=0.0))
    before = 9.81 * 0.5 * math.cos(0.5)
    for _ in range(300):
        world.advance(0.0, 0.01)
    assert 0.5 * (0.5 * world.rate) ** 2 + 9.81 * 0.5 * math.cos(world.angle) == pytest.approx(before, abs=0.02)


@pytest.mark.parametrize("direction", [0.0, 90.0, 180.0, 270.0])
@pytest.mark.parametrize("rate", [-1.5, 0.0, 1.5])
def test_the_watchdog_holds_the_angle_in_a_wind_that_it_does_not_know(direction: float, rate: float) -> None:
    robot = PendulumRobot(task_named("balance"), wind_towards(4.0, direction), seed=3)
    robot.world.put(math.radians(40.0 - math.degrees(0.25) * rate) if rate > 0 else math.radians(40.0))
    robot.world.rate = rate
    limp = PendulumWorld(robot.values[0], robot.world.wind)
    limp.rate = rate
    start = robot.values[0]
    for _ in range(200):
        robot.advance()
        limp.advance(0.0, 0.01)
    assert robot.watchdog_ticks == 200
    assert robot.state_message().applied_by == "watchdog"
    assert robot.collisions == []
    assert abs(robot.values[0] - start) < math.radians(6.0), "a degree of wind, and the way that the rate leads"
    assert abs(limp.angle - start) > math.radians(20.0), "limp it falls"


def test_the_watchdog_holds_again_where_the_next_torque_runs_out() -> None:
    robot = PendulumRobot(task_named("balance"), seed=3)
    robot.advance()
    for _ in range(20):
        robot.receive(reported(robot, 6.0))
        robot.advance()
    moved = robot.values[0]
    for _ in range(100):
        robot.advance()
    assert abs(robot.values[0] - moved) < 0.15


def test_leaving_the_corridor_counts_once_until_it_is_back() -> None:
    robot = PendulumRobot(task_named("balance"), seed=3)
    for _ in range(60):
        robot.receive(reported(robot, 10.0))
        robot.advance()
    assert robot.values[0] > math.pi / 4
    assert [item.what for item in robot.collisions] == ["upper edge"]
    assert robot.state_message().collisions == 1
    while abs(robot.values[0]) > 0.5:
        robot.receive(reported(robot, -10.0))
        robot.advance()
    while robot.values[0] > -math.pi / 4:
        robot.receive(reported(robot, -10.0))
        robot.advance()
    assert [item.what for item in robot.collisions] == ["upper edge", "lower edge"]
    assert "lower edge at t=" in str(robot.collisions[1])


def test_a_reached_goal_begins_a_new_swing_with_a_gap_in_the_ticks() -> None:
    robot = PendulumRobot(task_named("swing"), seed=1)
    assert robot.task.corridor[0] < robot.values[0] < robot.task.corridor[0] + 0.3
    robot.world.put(robot.task.goal)
    ticks = []
    while robot.goals_reached == 0:
        angle, rate = robot.values
        ticks.append(robot.tick)
        robot.receive(reported(robot, max(-10.0, min(10.0, -20.0 * (angle - robot.task.goal) - 3.0 * rate))))
        robot.advance()
    assert len(ticks) == 50, "half a second upright"
    assert robot.tick == ticks[-1] + 2
    assert robot.values[0] < robot.task.corridor[0] + 0.3
    assert robot.values[1] == 0.0
    assert robot.state_message().applied_by == "none"
    assert robot.collisions == []


def test_the_action_guard_refuses_with_a_reason() -> None:
    robot = PendulumRobot(task_named("balance"))
    assert robot.receive(reported(robot, 10.1)) == "out of range"
    assert robot.receive(reported(robot, math.nan)) == "not finite"
    assert robot.receive(reported(robot, 1.0, epoch=2)) == "wrong epoch"
    assert robot.receive(reported(robot, 1.0)) is None
    assert robot.receive(reported(robot, 1.0)) == "repeated"


def test_the_run_summary_has_task_wind_and_violations() -> None:
    robot = PendulumRobot(task_named("balance"), wind_towards(4.0, 90.0), seed=5)
    for _ in range(60):
        robot.receive(reported(robot, 10.0))
        robot.advance()
    account = summarise_run(robot, [0.001], 0, "time is over")
    assert account["task"] == "balance"
    assert account["wind"] == pytest.approx([0.0, 4.0], abs=1e-12)
    assert account["seed"] == 5
    assert account["collision_list"][0]["what"] == "upper edge"
    assert robot.at_rest


def test_seeds_draw_starts_and_invalid_pendulums_are_refused() -> None:
    one, two = (PendulumRobot(task_named("balance"), seed=seed) for seed in (1, 2))
    assert one.values != two.values
    assert one.values == PendulumRobot(task_named("balance"), seed=1).values
    with pytest.raises(InputError, match="period"):
        PendulumRobot(task_named("balance"), period=0.0)
    with pytest.raises(InputError, match="wind"):
        PendulumRobot(task_named("balance"), (math.nan, 0.0))
    with pytest.raises(InputError, match="balance"):
        task_named("balnce")


def swung(
    robot: PendulumRobot, ticks: int, model: str = "pendulum", *, filtered: bool = True, settings: str = "pendulum"
) -> tuple[list[Tick], list[ReceivedMessage]]:
    own, chosen = load_model(model), dataclasses.replace(settings_named(settings), enabled=filtered)
    heard: list[ReceivedMessage] = []
    nodes = [AdaptationNode(own), PolicyNode(own), SafetyFilterNode(own, chosen)]
    return list(drive(robot, nodes, ticks, hear=heard.append)), heard


def push(wind: tuple[float, ...], angle: float) -> float:
    """Returns the air force [N] along the arc on the mass at rest."""
    return 0.5 * math.hypot(*wind) * (wind[0] * math.cos(angle) - wind[1] * math.sin(angle))


@pytest.mark.parametrize("direction", [0.0, 45.0, 135.0, 180.0, 270.0])
def test_random_torques_in_an_unknown_wind_keep_the_corridor(direction: float) -> None:
    wind = wind_towards(4.0, direction)
    robot = PendulumRobot(task_named("balance"), wind, seed=1)
    ticks, heard = swung(robot, 300)
    assert robot.collisions == []
    assert {tick.verdict.status for tick in ticks} == {"passed", "corrected"}
    assert all(tick.refusal is None for tick in ticks)
    nominal_actions = [item.message.values[0] for item in heard if item.topic.name == "nominal"]
    assert min(nominal_actions) < -8.0
    assert max(nominal_actions) > 8.0, "over the whole of the motor's range"
    estimate = [item.message.values for item in heard if item.topic.name == "latent"][-1]
    angle = ticks[-1].state.values[0]
    assert push(estimate, angle) == pytest.approx(push(wind, angle), abs=0.4), "what acts along the arc is known"
    assert math.dist(estimate, wind) < 1.5, "the rest roughly: at one edge it hardly acts"


@pytest.mark.parametrize("direction", [0.0, 135.0])
def test_without_the_filter_it_is_left(direction: float) -> None:
    robot = PendulumRobot(task_named("balance"), wind_towards(4.0, direction), seed=1)
    ticks, _heard = swung(robot, 300, filtered=False)
    assert len(robot.collisions) > 0
    assert {tick.verdict.status for tick in ticks} == {"disabled"}


def test_the_learned_policy_gets_upright_the_long_way_round_again_and_again() -> None:
    robot = PendulumRobot(task_named("swing"), wind_towards(4.0, 135.0), seed=1)
    ticks, heard = swung(robot, 700, "pendulum_learned")
    assert robot.goals_reached >= 2
    assert robot.collisions == []
    assert {item.message.controller for item in heard if item.topic.name == "nominal"} == {"learned"}
    assert max(abs(tick.state.values[1]) for tick in ticks) > 2.0


def test_a_filter_that_knows_no_corridor_falls_back() -> None:
    robot = PendulumRobot(task_named("balance"), seed=1)
    reported = robot.state_message

    def silent() -> object:
        return dataclasses.replace(reported(), corridor=())

    robot.state_message = silent  # type: ignore[method-assign, assignment]
    ticks, _heard = swung(robot, 5)
    assert {tick.verdict.status for tick in ticks} == {"fallback"}
    assert {tick.verdict.action for tick in ticks} == {(0.0,)}


def test_a_lockstep_swing_repeats_bit_for_bit() -> None:
    hashes = set()
    for _repeat in range(2):
        robot = PendulumRobot(task_named("balance"), wind_towards(3.0, 30.0), seed=4)
        swung(robot, 60)
        hashes.add(robot.trajectory_hash)
    assert len(hashes) == 1


DEAD = range(100, 180)
"""Ticks; 0.8 s, in which the supervisor restarts it."""


def least_room(dead: str, direction: float, end: int = 240) -> tuple[float, PendulumRobot, list[VerdictMessage]]:
    """Random torques at 4 m/s; the service ``dead`` is silent in ``DEAD``, and its successor starts without state."""
    model = load_model("pendulum")
    robot = PendulumRobot(task_named("balance"), wind_towards(4.0, direction), seed=1)
    adaptation, keeper = AdaptationNode(model), SafetyFilterNode(model, settings_named("pendulum"))
    random, room, verdicts = np.random.default_rng(2), np.inf, []
    for tick in range(end):
        state, gone = robot.state_message(), tick in DEAD
        if tick == DEAD.stop and dead == "adaptation":
            adaptation = AdaptationNode(model)
        if tick == DEAD.stop and dead == "safety_filter":
            keeper = SafetyFilterNode(model, settings_named("pendulum"))
        latent: object = Stale(LATENT, None)
        if not (gone and dead == "adaptation"):
            latent = adaptation.step("r1", state, {})[LATENT]
            adaptation.afterwards("r1")
        torque = float(random.uniform(-10.0, 10.0))
        nominal: object = NominalMessage(
            epoch=state.epoch, tick=tick, robot_time=state.robot_time, publish_time=0.0, values=(torque,),
            controller="random",
        )  # fmt: skip
        if gone and dead == "policy":
            nominal = Stale(NOMINAL, None)
        if not (gone and dead == "safety_filter"):
            robot.receive(keeper.step("r1", state, {LATENT: latent, NOMINAL: nominal})[ACTION])
            verdicts.append(keeper.afterwards("r1")[VERDICT])
        robot.advance()
        room = min(room, np.pi / 4 - abs(robot.values[0]))
    return room, robot, verdicts


@pytest.mark.parametrize("dead", ["policy", "adaptation", "safety_filter"])
@pytest.mark.parametrize("direction", [0.0, 135.0, 270.0])
def test_the_corridor_is_kept(dead: str, direction: float) -> None:
    room, robot, verdicts = least_room(dead, direction)
    assert robot.collisions == []
    assert room > 0.0
    assert (robot.watchdog_ticks > 0) == (dead == "safety_filter")
    assert "fallback" not in {verdict.status for verdict in verdicts}


def test_a_missing_nominal_action_is_reported() -> None:
    verdict = least_room("policy", 0.0, DEAD.start + 1)[2][-1]
    assert verdict.nominal == ()
    assert verdict.status == "corrected"
    assert "the resting action stood in for it" in verdict.sentence
