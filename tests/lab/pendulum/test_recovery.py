"""What histories tell of the wind, and what training is sheltered by."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from safedpa_lab.pendulum.difficulty import Episodes
from safedpa_lab.pendulum.recovery import fitted_wind, recovery, swung_all_around
from safedpa_lab.pendulum.rollouts import blown
from safedpa_sim.pendulum.policy_task import CorridorShelter, starts_beneath
from safedpa_sim.pendulum.task import AHEAD, BALANCING, HAZARD, LONG_WAY_ROUND, TORQUE, in_hazard, is_upright

NOWHERE = Path("no models here")
"""So that those that ship are taken."""


def test_the_best_fit_finds_the_wind_that_blew() -> None:
    episodes = Episodes(3, 8, 1)
    wind, state = episodes.winds(), episodes.upright_starts()
    random = np.random.default_rng(4)
    states, torques = [state], []
    for _ in range(40):
        torque = random.uniform(-TORQUE, TORQUE, (8, 1))
        states.append(blown(states[-1], torque, wind))
        torques.append(torque[:, 0])
    np.testing.assert_allclose(fitted_wind(np.stack(states), np.stack(torques)), wind, atol=1e-4)


def test_the_latent_gives_the_direction_and_the_networks_refine_it() -> None:
    swings = swung_all_around(NOWHERE, Episodes(2, 8, 1))
    found = recovery(swings, NOWHERE, 8, seed=2)
    assert found["best_median_degrees"] < 0.5
    assert found["median_degrees"] < 45.0, "a quarter of what knowing nothing gives"
    assert found["refined_median_degrees"] < found["median_degrees"]
    assert len(found["latents"]) == len(found["refined"]) == len(found["directions"]) == 8


@settings(max_examples=50, deadline=None)
@given(st.floats(-0.7, 0.7), st.floats(-0.6, 0.6), st.floats(-TORQUE, TORQUE), st.floats(0.0, 6.28))
def test_the_shelter_keeps_the_corridor(angle: float, ahead: float, torque: float, direction: float) -> None:
    state = torch.tensor([[angle, (ahead - angle) / AHEAD]], dtype=torch.float64)
    wind = 4.0 * np.array([[np.cos(direction), np.sin(direction)]])

    def after(bound: torch.Tensor) -> torch.Tensor:
        return torch.from_numpy(blown(state.numpy(), bound.numpy(), wind))

    kept = CorridorShelter(1, BALANCING).decide(after, state, torch.tensor([[torque]], dtype=torch.float64))
    following = after(kept)[0]
    room = BALANCING[1] - abs(float(following[0] + AHEAD * following[1]))
    assert room >= 0.5 * (BALANCING[1] - abs(ahead)) - 1e-3
    assert abs(float(kept)) <= TORQUE


def test_starts_lie_in_the_safe_set_and_move_towards_the_hazard() -> None:
    starts = starts_beneath(500, np.random.default_rng(1))
    ahead = starts[:, 0] + AHEAD * starts[:, 1]
    assert (starts[:, 1] <= 0.0).all()
    assert (ahead >= LONG_WAY_ROUND[0]).all()
    assert not in_hazard(starts[:, 0]).any()


@pytest.mark.parametrize("turns", [-1, 0, 1, 2])
def test_turns_do_not_matter(turns: int) -> None:
    middle = sum(HAZARD) / 2 + 2 * np.pi * turns
    assert in_hazard(np.array([middle])).all()
    assert is_upright(np.array([[2 * np.pi * turns, 0.5]])).all()
    assert not is_upright(np.array([[middle, 0.0]])).any()
