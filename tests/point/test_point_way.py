"""The shortest way around hazards, what the policy sees, its teacher; recovery where the wind is believed wrong."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safedpa.safety.stopping_barrier import Motion
from safedpa_sim.point.belief import Believed, TrueBelief
from safedpa_sim.point.body_steps import centre_state
from safedpa_sim.point.filtering import ETA, PointFilter
from safedpa_sim.point.layout import HAZARD_RADIUS
from safedpa_sim.point.observation import entries_seen, policy_seen
from safedpa_sim.point.task import PointTask
from safedpa_sim.point.way import BERTH, Ways, taught

FAR = np.full((7, 2), 9.0) + np.arange(7)[:, None]


def _one(middle: tuple[float, float]) -> np.ndarray:
    return np.concatenate((np.array([middle]), FAR))[np.newaxis]


def test_a_free_way_is_straight_and_a_barred_one_goes_around() -> None:
    ways, place, goal = Ways(1), np.array([[-1.0, 0.0]]), np.array([[1.0, 0.0]])
    turn, length = ways.first_turns(place, _one((0.0, 1.0)), goal)
    assert turn == pytest.approx(goal)
    assert length == pytest.approx([2.0])
    turn, length = ways.first_turns(place, _one((0.0, 0.05)), goal)
    assert turn[0, 1] < -0.1, "the shorter side"
    tangents, radius = 2.0 * np.sqrt(1.0 - 0.3**2), HAZARD_RADIUS + BERTH
    assert tangents < length[0] < 2.0 * np.hypot(1.0, radius + 0.05)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10_000))
def test_ways_keep_off_hazards_and_are_never_shorter_than_the_straight_line(seed: int) -> None:
    task = PointTask(4, seed)
    place, layout = task.simulation.pose[:2].T, task.layout
    turn, length = Ways(4).first_turns(place, layout.hazards, layout.goal)
    assert np.all(length >= np.linalg.norm(layout.goal - place, axis=1) - 1e-5)
    for share in np.linspace(0.0, 1.0, 21)[:, np.newaxis]:
        on_it = place + share * (turn - place)
        assert np.linalg.norm(layout.hazards - on_it[:, np.newaxis], axis=2).min() > HAZARD_RADIUS + 0.005


def test_what_is_seen_turns_with_the_world() -> None:
    task, latent = PointTask(6, 2), np.zeros((6, 2))
    task.simulation.velocity[:] = np.random.default_rng(0).normal(size=(3, 6))
    before = policy_seen(task, latent, task.layout.goal)
    assert before.shape == (6, entries_seen(2))
    angle = 0.7
    matrix = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    task.simulation.pose[:2], task.simulation.velocity[:2] = (
        matrix @ part[:2] for part in (task.simulation.pose, task.simulation.velocity)
    )
    task.simulation.pose[2] += angle
    task.layout.goal, task.layout.hazards = (part @ matrix.T for part in (task.layout.goal, task.layout.hazards))
    assert policy_seen(task, latent, task.layout.goal) == pytest.approx(before, abs=1e-9)


def test_the_teacher_pushes_towards_the_turn_and_against_the_wind() -> None:
    state, motion = np.zeros((2, 5)), Motion(np.array([0.0, 0.0]), 1.93, 2.89, 3.0)
    ahead = taught(state, np.array([[1.0, 0.0], [0.0, 1.0]]), motion)
    assert ahead[0] == pytest.approx([1.0, 0.0], abs=1e-9)
    assert ahead[1, 1] > 0.9
    against = taught(np.array([[0.0, 0.0, 0.0, 0.9, 0.0]]), np.array([[1.0, 0.0]]), motion)
    assert against[0, 0] == pytest.approx(0.9 * 1.93 / 2.89)


@pytest.mark.long
def test_a_robot_that_believes_a_wrong_wind_is_not_blown_into_the_hazard_next_to_it() -> None:
    """It pushes itself away where h < epsilon / eta, although by what it believes it stands still."""
    task = PointTask(1, 0)
    task.layout.hazards[:] = _one((0.0, 0.0))
    task.simulation.pose[:, 0] = -(HAZARD_RADIUS + 0.004), 0.0, 0.0
    task.simulation.force[:, 0] = 0.008, 0.0
    least, shelter = 1.0, PointFilter(0.002)
    for _ in range(300):
        state = centre_state(task.simulation)
        action = shelter.decide(state, np.ones((1, 2)), task.layout.hazards, _mistaken(state)).action
        task.advance(action * np.array([1.0, 0.5]))
        least = min(least, float(task.hazard_distance()[0]))
    assert least > 0.0
    assert float(task.hazard_distance()[0]) > 0.5 * 0.002 / ETA


def _mistaken(state: np.ndarray) -> Believed:
    """The truth but for 0.2 m/s2 of the wind."""
    from safedpa_sim.point.simulation import PointSimulation

    other = PointSimulation(1)
    other.force[:, 0] = 0.008 - 0.2 * other.body.mass, 0.0
    return TrueBelief(other).believed(state, np.zeros((1, 0)))
