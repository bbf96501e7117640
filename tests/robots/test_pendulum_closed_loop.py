"""The pendulum behind the real nodes of the services, in lockstep."""

from __future__ import annotations

import dataclasses
import math

import pytest

from safedpa.adaptation import AdaptationNode
from safedpa.bus import Received
from safedpa.dynamics import load_model
from safedpa.policy import PolicyNode
from safedpa.safety.node import SafetyFilterNode
from safedpa.safety.shipped import settings_named
from safedpa_sim.closed_loop import Tick, drive
from safedpa_sim.robots import PendulumRobot, task_named, wind_towards


def swung(
    robot: PendulumRobot, ticks: int, model: str = "pendulum", *, filtered: bool = True, settings: str = "pendulum"
) -> tuple[list[Tick], list[Received]]:
    own, chosen = load_model(model), dataclasses.replace(settings_named(settings), enabled=filtered)
    heard: list[Received] = []
    nodes = [AdaptationNode(own), PolicyNode(own), SafetyFilterNode(own, chosen)]
    return list(drive(robot, nodes, ticks, hear=heard.append)), heard


def push(wind: tuple[float, ...], angle: float) -> float:
    """Force of the air [N] along the arc on the mass at rest."""
    return 0.5 * math.hypot(*wind) * (wind[0] * math.cos(angle) - wind[1] * math.sin(angle))


@pytest.mark.parametrize("direction", [0.0, 45.0, 135.0, 180.0, 270.0])
def test_random_torques_in_an_unknown_wind_keep_the_corridor(direction: float) -> None:
    wind = wind_towards(4.0, direction)
    robot = PendulumRobot(task_named("balance"), wind, seed=1)
    ticks, heard = swung(robot, 300)
    assert robot.collisions == []
    assert {tick.verdict.status for tick in ticks} == {"passed", "corrected"}
    assert all(tick.refusal is None for tick in ticks)
    wishes = [item.message.values[0] for item in heard if item.topic.name == "wish"]
    assert min(wishes) < -8.0
    assert max(wishes) > 8.0, "over the whole of the motor's range"
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
    assert {item.message.controller for item in heard if item.topic.name == "wish"} == {"learned"}
    assert max(abs(tick.state.values[1]) for tick in ticks) > 2.0


def test_a_filter_that_knows_no_corridor_falls_back() -> None:
    robot = PendulumRobot(task_named("balance"), seed=1)
    told = robot.state_message

    def silent() -> object:
        return dataclasses.replace(told(), corridor=())

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
