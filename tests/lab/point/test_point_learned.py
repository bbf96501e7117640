"""The learned point robot: body, networks, beliefs, latents, filter, heat map, each held against another road."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from safedpa.adaptation.histories import Histories
from safedpa.dynamics import load_model
from safedpa.errors import InputError
from safedpa.networks import HistoryEncoder, LearnedNetworks, frame_of
from safedpa_lab.experiments.point_heat_map import heat_map_markdown, write_heat_map
from safedpa_lab.point.beliefs import LearnedBelief, ModelBelief, from_task_action
from safedpa_lab.point.heat_map import HeatMap, agreement, heat_map
from safedpa_lab.point.margin import one_step_errors
from safedpa_lab.point.moments import drawn_moments
from safedpa_lab.point.shield import Shield, shield_of
from safedpa_lab.point.weights import weights_named
from safedpa_sim.point.belief import ACTION_SCALE, TrueBelief, to_task_action
from safedpa_sim.point.body_steps import after_one_period, centre_state, put_state
from safedpa_sim.point.filtering import PointFilter, least_room
from safedpa_sim.point.simulation import PointSimulation
from safedpa_sim.point.task import PointTask
from safedpa_sim.training.configuration import load_configuration
from safedpa_sim.training.simulator import BatchedCars

FORCE = 0.008


def _states(count: int, seed: int) -> np.ndarray:
    random = np.random.default_rng(seed)
    return np.c_[random.uniform(-1, 1, (count, 2)), random.uniform(-3, 3, count), random.uniform(-1.2, 1.2, (count, 2))]


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000))
def test_the_state_of_the_centre_of_mass_is_put_as_it_is_read(seed: int) -> None:
    simulation, state = PointSimulation(4), _states(4, seed)
    put_state(simulation, state, np.random.default_rng(seed).uniform(-3, 3, 4))
    assert np.allclose(centre_state(simulation), state, atol=1e-12)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000), st.floats(-3.0, 3.0))
def test_a_point_robot_turned_elsewhere_moves_alike(seed: int, angle: float) -> None:
    """features and own-frame increments of turned states are those of the states; the way back gives the change."""
    frame, before, after = frame_of("point"), _states(3, seed), _states(3, seed + 1)
    matrix = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])

    def turned(state: np.ndarray) -> np.ndarray:
        return np.c_[state[:, :2] @ matrix.T, state[:, 2] + angle, state[:, 3:] @ matrix.T]

    own = frame.own_increment(before, after)
    assert np.allclose(frame.own_increment(turned(before), turned(after)), own, atol=1e-9)
    assert np.allclose(frame.features(turned(before))[:, 2:], frame.features(before)[:, 2:], atol=1e-9)
    change = frame.world_increment(before, own)
    assert np.allclose(change[:, [0, 1, 3, 4]], (after - before)[:, [0, 1, 3, 4]], atol=1e-9)


def test_the_body_in_training_is_nearly_the_model_that_people_read() -> None:
    cars = BatchedCars(load_configuration("point"))
    generator = cars.generator(0)
    environment, state, action = (
        draw(500, generator) for draw in (cars.draw_environments, cars.draw_states, cars.draw_actions)
    )
    following, rate = cars.advance(state, action, environment)
    modelled, _ = cars.model.advance(state, action, (), environment)
    spread = (following - state).std(0)
    assert ((following - modelled).std(0) < 0.03 * spread).all()
    again, _ = cars.advance(following, action, environment, rate)
    assert torch.isfinite(again).all()


def test_the_true_belief_predicts_what_the_simulator_does() -> None:
    random, state = np.random.default_rng(1), _states(60, 0)
    simulation = PointSimulation(60)
    simulation.force[:] = random.uniform(-FORCE, FORCE, (2, 60))
    action = np.c_[random.uniform(-1, 1, 60), random.uniform(-0.6, 0.6, 60)]
    done = action * ACTION_SCALE
    following, _ = after_one_period(state, done, done[:, 1], simulation.force.T / simulation.body.mass)
    told = TrueBelief(simulation).believed(state, np.zeros((60, 0))).next_state(action)
    assert np.abs(told - following).max() < 2e-3


def test_models_and_networks_show_at_the_probes_how_the_robot_moves() -> None:
    random, state = np.random.default_rng(2), _states(30, 1)
    simulation = PointSimulation(30)
    simulation.force[:] = random.uniform(-0.005, 0.005, (2, 30))
    true = TrueBelief(simulation).believed(state, np.zeros((30, 0)))
    weights = weights_named("learned")
    latent = LearnedNetworks(weights).encode(simulation.force.T / simulation.body.mass)
    learned = LearnedBelief(weights).believed(state, latent)
    assert np.abs(learned.motion.wind - true.motion.wind).max() < 0.1
    assert np.abs(learned.motion.strongest - true.motion.strongest).max() < 0.1
    assert np.abs(learned.motion.drag - true.motion.drag).max() < 0.15
    action = random.uniform(-1, 1, (30, 2))
    assert np.abs(learned.next_state(action) - true.next_state(action)).max() < 8e-3
    plain = ModelBelief(load_model("point")).believed(state, np.zeros((30, 0)))
    assert plain.motion.wind == pytest.approx([0.0, 0.0], abs=1e-9)
    assert plain.motion.strongest == pytest.approx(0.015 / 0.005189, rel=1e-3)
    alone = LearnedBelief(weights_named("fix_135")).believed(state, np.zeros((30, 0)))
    assert alone.motion.wind == pytest.approx([-1.089, 1.089], abs=0.1)


@settings(max_examples=30, deadline=None)
@given(st.floats(-1, 1), st.floats(-1, 1))
def test_actions_of_the_task_and_of_the_filter_are_one(thrust: float, turn: float) -> None:
    action = np.array([[thrust, turn]])
    assert from_task_action(to_task_action(action)) == pytest.approx(action, abs=1e-12)
    assert np.all(np.abs(to_task_action(action)) <= 1.0)


def test_latents_are_those_of_the_encoder_over_the_same_history() -> None:
    weights, random = weights_named("learned"), np.random.default_rng(3)
    encoder, adaptation = HistoryEncoder(weights), Histories(weights, 2)
    states, actions = random.normal(0, 0.3, (71, 2, 5)), random.normal(0, 0.005, (70, 2, 2))
    for state, action in zip(states[:-1], actions, strict=True):
        adaptation.see(state)
        adaptation.acted(action)
    seen = adaptation.see(states[-1])
    rows = encoder.rows(states.transpose(1, 0, 2), actions.transpose(1, 0, 2))
    assert seen == pytest.approx(encoder.encode(encoder.padded(rows)), abs=1e-5)
    adaptation.reset(np.array([0]))
    fresh = adaptation.see(states[0])
    assert fresh[0] == pytest.approx(encoder.encode(np.zeros((encoder.length, encoder.row_length))), abs=1e-5)


@pytest.mark.long
def test_a_robot_within_a_hazard_is_led_out_of_it() -> None:
    """Recovery: wherever h < 0, the room grows until there is some."""
    task = PointTask(12, 3)
    task.simulation.pose[:2] = task.layout.hazards[:, 0].T + 0.05
    shield = Shield(12, TrueBelief(task.simulation), None)
    wish = np.tile(np.array([0.2, 0.0]), (12, 1))
    for _ in range(100):
        task.advance(shield.act(task, wish).action)
    assert np.all(task.hazard_distance() > 0.0)


def test_recovery_takes_the_action_that_leaves_most_room() -> None:
    simulation = PointSimulation(8)
    state = _states(8, 5)
    hazards = state[:, np.newaxis, :2] + np.array([[[0.12, 0.02], [2.0, 2.0]]])
    believed = TrueBelief(simulation).believed(state, np.zeros((8, 0)))
    chosen = PointFilter(0.0).decide(state, np.ones((8, 2)), hazards, believed)
    reached = least_room(believed.next_state(chosen.action), hazards, believed.motion)
    lost = chosen.relaxed
    assert lost.sum() >= 4
    for tried in np.random.default_rng(0).integers(-2, 3, (12, 2)) / 2.0:
        other = least_room(believed.next_state(np.tile(tried, (8, 1))), hazards, believed.motion)
        assert np.all(reached[lost] >= other[lost] - 2e-4)


@pytest.mark.long
def test_safedpa_keeps_out_of_hazards_in_a_wind_that_fix_runs_into() -> None:
    unsafe = {}
    for method in ("safedpa", "fix_315"):
        task, random = PointTask(24, 11), np.random.default_rng(0)
        task.simulation.force[:] = FORCE * np.array([[np.cos(2.356)], [np.sin(2.356)]])
        shield = shield_of(method, task)
        cost = np.zeros(24)
        for step in range(120):
            if step % 50 == 0:
                wish = random.uniform((0.0, -0.5), (1.0, 0.5), (24, 2))
            cost += task.advance(shield.act(task, wish).action).cost
        unsafe[method] = int((cost > 0).sum())
    assert unsafe["safedpa"] <= 1
    assert unsafe["fix_315"] >= 5 + unsafe["safedpa"]


@pytest.fixture(scope="module")
def small_map() -> dict[str, Any]:
    return heat_map(HeatMap(points=7, moments=16, shown=2))


@pytest.mark.long
def test_the_heat_map_of_safedpa_is_that_of_the_simulator(small_map: dict[str, Any]) -> None:
    result = small_map
    found = {name: row["rank_correlation"] for name, row in result["agreement"].items()}
    assert found["safedpa"] > 0.95
    assert all(found["safedpa"] > found[f"fix_{direction}"] for direction in (45, 225, 315))
    assert np.shape(result["shown"]["reference"]) == (2, 7, 7)
    same = agreement(np.arange(12.0).reshape(3, 4), np.arange(12.0).reshape(3, 4))
    assert (same["correlation"], same["rank_correlation"], same["error"]) == pytest.approx((1.0, 1.0, 0.0))


@pytest.mark.long
def test_a_heat_map_is_drawn(small_map: dict[str, Any], tmp_path: Path) -> None:
    result = {"date": "today", **small_map}
    write_heat_map(result, tmp_path)
    assert (tmp_path / "point_heat_map.png").stat().st_size > 10_000
    assert heat_map_markdown(result).count("\n| ") == 7


@pytest.mark.long
def test_most_one_step_errors_of_h_are_below_the_margin() -> None:
    weights = weights_named("learned")
    moments = drawn_moments(weights, robots=40, steps=80, seed=5, force=FORCE)
    errors = one_step_errors(weights, moments)
    assert len(errors) > 15
    assert (errors <= 0.003).mean() > 0.93


def test_mistakes_are_named() -> None:
    task = PointTask(2, 0)
    with pytest.raises(InputError, match="method 'fix_90'"):
        shield_of("fix_90", task)
    with pytest.raises(InputError, match="got no model to adapt with"):
        shield_of("safedpa", task, adapts="")
    with pytest.raises(InputError, match="safedpa train point"):
        weights_named("nobody")
    with pytest.raises(InputError, match="no more shown"):
        HeatMap(moments=2, shown=3)
