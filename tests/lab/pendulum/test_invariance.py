"""The barrier for 45 degrees can always be kept, what histories tell of the wind, what training is sheltered by."""

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from safedpa.safety import SafetyFilter
from safedpa_lab.pendulum.difficulty import Episodes
from safedpa_lab.pendulum.invariance import largest_wind, least_reserve, reserve
from safedpa_lab.pendulum.recovery import fitted_wind, recovery, swung_all_around
from safedpa_lab.pendulum.rollouts import blown, physics_in_any_wind
from safedpa_sim.pendulum.policy_task import CorridorFilter, starts_beneath
from safedpa_sim.pendulum.task import (
    AHEAD,
    BALANCING,
    HAZARD,
    LONG_WAY_ROUND,
    TORQUE,
    WIND,
    corridor,
    filter_settings,
    in_hazard,
    is_upright,
)

EPSILON = 0.003
share = st.floats(0.0, 1.0)


def inside(edges: tuple[float, float], angle: float, ahead: float) -> np.ndarray:
    """The state of the set at these shares of angle and s."""
    low, high = edges
    first, then = (low + part * (high - low) for part in (angle, ahead))
    return np.array([first, (then - first) / AHEAD])


@pytest.mark.parametrize("edges", [BALANCING, LONG_WAY_ROUND], ids=["balancing", "long way round"])
def test_a_torque_is_always_left(edges: tuple[float, float]) -> None:
    least = least_reserve(WIND, edges, epsilon=EPSILON)
    assert least.torque > 0.5, least


@pytest.mark.long
@settings(max_examples=300, deadline=None)
@given(share, share, st.floats(0.0, 2 * np.pi), st.sampled_from([BALANCING, LONG_WAY_ROUND]))
def test_the_filter_that_knows_the_wind_keeps_every_state(angle, ahead, direction, edges) -> None:
    """From anywhere in the set, whatever action is requested: the next state is in the set, and the filter did not give
    way.

    A state on the edge may lie outside by its last digit; then the filter says so, and the next state is in the set.
    """
    state = inside(edges, angle, ahead)
    wind = WIND * np.array([np.cos(direction), np.sin(direction)])
    item = SafetyFilter.for_model(physics_in_any_wind(), filter_settings(EPSILON), [corridor(edges)])
    h_now = corridor(edges).h(state).min()
    assert h_now > -1e-14
    for nominal in (-TORQUE, TORQUE):
        verdict = item.decide(state, [nominal], wind)
        assert verdict.status.value in (("passed", "corrected") if h_now >= 0.0 else ("violated",))
        following = blown(state[None], verdict.action[None], wind[None])[0]
        assert corridor(edges).h(following).min() >= -1e-4
        assert edges[0] - 1e-9 <= following[0] <= edges[1] + 1e-9


@pytest.mark.long
def test_the_largest_wind_is_where_static_torques_say() -> None:
    """At 45 degrees and standstill: gravity and the wind along the motion together are the motor's torque."""
    gravity, area = 9.81 * 0.5 * np.sin(np.pi / 4), 0.5 * 0.5
    assert largest_wind() == pytest.approx(np.sqrt((TORQUE - gravity) / area), abs=0.03)
    assert least_reserve(largest_wind() + 0.05).torque < 0.0
    assert largest_wind(epsilon=EPSILON) < largest_wind()


def test_the_reserve_is_that_of_the_true_dynamics() -> None:
    """With the whole reserve of torque taken away the condition still holds; with a little more it does not."""
    state, wind = inside(BALANCING, 1.0, 0.9), np.array([WIND, 0.0])
    left = reserve(state[None], wind[None], BALANCING, 0.5, 0.0)[0]
    low, high = BALANCING
    now = state[0] + AHEAD * state[1]
    for torque, holds in ((-TORQUE + 0.99 * left, True), (-TORQUE + 1.01 * left, False)):
        following = blown(state[None], np.array([[torque]]), wind[None])[0]
        after = following[0] + AHEAD * following[1]
        assert bool(high - after >= 0.5 * (high - now)) is holds
        assert after - low >= 0.5 * (now - low) or not holds


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

    retained = CorridorFilter(1, BALANCING).decide(after, state, torch.tensor([[torque]], dtype=torch.float64))
    following = after(retained)[0]
    room = BALANCING[1] - abs(float(following[0] + AHEAD * following[1]))
    assert room >= 0.5 * (BALANCING[1] - abs(ahead)) - 1e-3
    assert abs(float(retained)) <= TORQUE


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
