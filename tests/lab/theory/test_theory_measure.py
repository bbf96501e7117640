"""Constants and margins measured on transitions, and what they promise on fresh states."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as some

from safedpa.errors import InputError
from safedpa.networks import LearnedNetworks, Weights, dense_stack, frame_of
from safedpa.networks.layers import layers_of
from safedpa.safety import (
    FilterSettings,
    FunctionBarrier,
    SafetyFilter,
)
from safedpa.safety.solver.least_violation import TOLERANCE
from safedpa_lab.theory.boundary_layer import Stay, least_after, stays_in_layer
from safedpa_lab.theory.measure import (
    Branches,
    affine_parts,
    error_constants,
    lipschitz_constants,
    measured_errors,
    network_parts,
)


@pytest.fixture(scope="module")
def sampled(random_car_weights: Callable[..., Weights]) -> Callable[..., tuple[Weights, LearnedNetworks, Branches]]:
    """Networks, and branches of a truth: other networks of the latent, and a part that bends with the action."""

    def draw(own: int, seed: int, count: int = 60, off: float = 0.3, bend: float = 0.05, latents: int = 2):
        random = np.random.default_rng(seed)
        known, truth = (random_car_weights(each, latents=latents, width=8) for each in (own, 99))
        state = random.uniform((-3, -3, -3, -0.5), (3, 3, 3, 2), (count, 4))
        latent = random.normal(size=(count, latents))
        u = random.uniform(-1, 1, (count, 9, 2))
        F, G = network_parts(LearnedNetworks(truth), state, latent)
        v = F[:, None] + np.einsum("nsa,nka->nks", G, u) + bend * np.sin(3.0 * u[..., :1])
        increment = v * known["increment_scale"]
        repeated = np.broadcast_to(state[:, None], increment.shape)
        seen = Branches(
            state=state, latent=latent, deployed=latent + off * random.normal(size=latent.shape),
            action=known["action_middle"] + u * known["action_scale"],
            following=repeated + frame_of("car").world_increment(repeated, increment),
        )  # fmt: skip
        return known, LearnedNetworks(known), seen

    return draw


@given(some.integers(0, 10_000))
@settings(max_examples=25, deadline=None)
def test_no_measured_step_exceeds_the_bound_of_its_own_constants(sampled, seed: int) -> None:
    _, networks, seen = sampled(seed, seed)
    errors = measured_errors(networks, seen)
    constants = error_constants(errors, lipschitz_constants(networks, seen))
    assert (errors["step"] <= constants.of_step(errors["effort"]) * (1 + 1e-5)).all()


def test_fresh_steps_are_covered_at_least_as_promised(sampled) -> None:
    (_, networks, first), (_, _, fresh) = sampled(3, 1, 1500), sampled(3, 2, 1500)
    constants = error_constants(measured_errors(networks, first), lipschitz_constants(networks, first), 0.95)
    later = measured_errors(networks, fresh)
    assert (later["step"] <= constants.of_step(later["effort"])).mean() >= 0.95


def test_a_network_that_is_the_truth_errs_by_the_latents_alone_summed_over_their_entries(sampled) -> None:
    _, networks, seen = sampled(99, 4, bend=0.0)
    errors = measured_errors(networks, seen)
    for name in ("f", "g", "remainder"):
        assert errors[name].max() < 1e-5
    assert errors["latent"].min() > 0.0
    assert errors["step"].max() > 1e-3  # from the latent alone
    moved = Branches(seen.state, seen.latent, seen.latent + np.array([0.25, -0.5]), seen.action, seen.following)
    assert measured_errors(networks, moved)["latent"] == pytest.approx(0.75)


def test_each_error_is_the_largest_of_its_entries(sampled) -> None:
    known, networks, seen = sampled(12, 4)
    errors = measured_errors(networks, seen)
    u = (seen.action - known["action_middle"]) / known["action_scale"]
    own = frame_of("car").own_increment(seen.state[:, None], seen.following)
    v = own / known["increment_scale"]
    F, G = network_parts(networks, seen.state, seen.latent)
    F_true, G_true, remainder = affine_parts(u, v)
    F_there, G_there = network_parts(networks, seen.state, seen.deployed)
    for i in (0, 31, 59):
        assert errors["f"][i] == pytest.approx(max(abs(F_true[i, s] - F[i, s]) for s in range(4)))
        assert errors["g"][i] == pytest.approx(max(abs(G_true[i, s, a] - G[i, s, a]) for s in range(4) for a in (0, 1)))
        assert errors["remainder"][i] == remainder[i]
        for k in range(9):
            step = v[i, k] - (F_there[i] + G_there[i] @ u[i, k])
            assert errors["step"][i, k] == pytest.approx(np.abs(step).max())
            assert errors["effort"][i, k] == pytest.approx(abs(u[i, k, 0]) + abs(u[i, k, 1]))


def test_slopes_are_those_at_the_branches_own_states_and_latents(sampled) -> None:
    known, networks, seen = sampled(5, 1)
    largest = 0.0
    for state, latent in zip(seen.state, seen.deployed, strict=True):
        for entry in range(2):
            moved = np.tile(latent, (2, 1))
            moved[:, entry] += (-1e-3, 1e-3)
            scaled = (frame_of("car").features(state) - known["feature_middle"]) / known["feature_scale"]
            out = dense_stack(np.column_stack([np.tile(scaled, (2, 1)), moved]), layers_of(known.tensors, "f"), "relu")
            largest = max(largest, float(np.abs(out[1] - out[0]).max()) / 2e-3)
    found = lipschitz_constants(networks, seen)
    assert found["f"][1] == pytest.approx(largest, rel=0.05)
    assert all(0.0 < slope <= upper for upper, slope in found.values())
    _, networks, seen = sampled(5, 1, latents=0)
    assert lipschitz_constants(networks, seen) == {"f": (0.0, 0.0), "g": (0.0, 0.0)}


def test_too_few_states_or_actions_that_do_not_separate_the_parts_are_refused(sampled) -> None:
    line = np.tile(np.linspace(-1.0, 1.0, 9)[None, :, None], (2, 1, 2))
    all_ways = np.random.default_rng(0).uniform(-1, 1, (2, 4, 2))
    for action in (line, all_ways[:, :3], np.concatenate([line[:1, :4], all_ways[:1]])):
        with pytest.raises(InputError, match="wanted at least 4 that point all ways"):
            affine_parts(action, np.zeros((*action.shape[:2], 4)))
    assert affine_parts(all_ways, np.ones((2, 4, 4)))[0] == pytest.approx(1.0), "four are enough"
    _, networks, seen = sampled(3, 1)
    errors = measured_errors(networks, seen)
    with pytest.raises(InputError, match="got 60 states, too few"):
        error_constants(errors, {"f": (1.0, 1.0), "g": (1.0, 1.0)}, 0.99)
    short = errors | {"f": errors["f"][:10]}
    with pytest.raises(InputError, match="too few"):
        error_constants(short, {"f": (1.0, 1.0), "g": (1.0, 1.0)}, 0.9)


def test_network_parts_predict_what_the_networks_predict(sampled) -> None:
    known, networks, seen = sampled(7, 1)
    f, g = networks.own_increment(seen.state, seen.latent)
    F, G = network_parts(networks, seen.state, seen.latent)
    u = (seen.action[:, 0] - known["action_middle"]) / known["action_scale"]
    scaled = F + np.einsum("nsa,na->ns", G, u)
    plain = f + np.einsum("nsa,na->ns", g, seen.action[:, 0])
    assert scaled * known["increment_scale"] == pytest.approx(plain, rel=1e-5, abs=1e-7)


def test_branches_that_do_not_fit_are_refused(sampled) -> None:
    _, _, seen = sampled(1, 1)
    alone = [part[:1] for part in (seen.state, seen.latent, seen.deployed, seen.action, seen.following)]
    assert Branches(*alone).action.shape == (1, 9, 2)
    with pytest.raises(InputError, match="n > 0"):
        Branches(*(part[:0] for part in alone))
    with pytest.raises(InputError, match="deployed"):
        Branches(seen.state, seen.latent, seen.deployed[:5], seen.action, seen.following)
    with pytest.raises(InputError, match="state"):
        Branches(seen.state[:5], seen.latent, seen.deployed, seen.action, seen.following)


ETA, EPSILON, STEP = 0.2, 0.02, 0.1
DEPTH = EPSILON / ETA


def driven(lowest: float, error: float, h: float, steps: int, *, at_rest: bool = False):
    """h measured and predicted of x+ = x + 0.1 a, h = 1 - x, pushed towards the wall by ``error`` in every step.

    ``at_rest``: a robot that stands is not pushed.
    """
    settings = FilterSettings(
        action_low=(lowest,), action_high=(1.0,), backup_action=(max(lowest, 0.0),), eta=ETA, epsilon=EPSILON
    )
    barrier = FunctionBarrier(lambda x: 1.0 - x[0])
    safe = SafetyFilter(lambda x: (x, np.array([[STEP]])), [barrier], settings)
    x, now, then = 1.0 - h, [], []
    for _ in range(steps):
        verdict = safe.decide(np.array([x]), nominal=[1.0])
        now.append(verdict.h_now)
        then.append(verdict.h_next)
        moved = STEP * float(verdict.action[0])
        x += moved + (0.0 if at_rest and abs(moved) < 1e-6 else error)
    return now, then


@pytest.mark.long
@pytest.mark.parametrize("h", [0.0, 0.01, 0.05, DEPTH])
@pytest.mark.parametrize("error", [0.0, 0.01, EPSILON])
def test_where_an_action_raises_h_by_the_error_h_stays_above_0_wherever_it_begins(h: float, error: float) -> None:
    given_away = TOLERANCE * (
        STEP + 2.0 * error
    )  # of what the actions can change in h, for the least change of a nominal action
    now, then = driven(-(error + given_away) / STEP, error, h, 300)
    assert min(now) >= min(h, (EPSILON - error) / ETA) - 1e-9, "where the condition is satisfied h tends to the second"
    bound = least_after(h, [error] * 300, [error] * 300, ETA)
    assert bound >= -1e-12
    assert min(now) >= bound - 1e-9
    assert all(stay.least_rise >= -1e-9 for stay in stays_in_layer(now, then, [DEPTH] * 300))


def test_where_actions_only_keep_h_errors_add_up_and_no_filter_helps() -> None:
    error = 0.005
    now, then = driven(0.0, error, DEPTH, 60)
    first = next(tick for tick, h in enumerate(now) if h < -1e-9)
    assert first in (20, 21), "the layer's depth over the error of a step"
    (stay,) = stays_in_layer(now, then, [DEPTH] * 60)
    assert stay.least_rise == pytest.approx(0.0, abs=1e-9), (
        "nothing of what there is may be given away, tick after tick"
    )
    assert stay.fall == pytest.approx(stay.errors, abs=1e-7)
    assert least_after(DEPTH, [0.0] * 59, [error] * 59, 0.0) == pytest.approx(now[-1], abs=1e-7)


def test_a_robot_that_stands_errs_no_more_and_stays_in_the_layer() -> None:
    now, then = driven(0.0, EPSILON, 2.0 * DEPTH, 100, at_rest=True)
    assert min(now) >= DEPTH - EPSILON - 1e-9
    assert now[-1] == pytest.approx(now[-20], abs=1e-6)
    assert all(stay.errors <= EPSILON + 1e-9 for stay in stays_in_layer(now, then, [DEPTH] * 100))


def test_the_layer_follows_a_worked_example() -> None:
    now = [0.5, 0.08, 0.06, 0.2, 0.05]
    then = [0.1, 0.09, 0.25, 0.1, 0.05]
    stays = stays_in_layer(now, then, [0.1] * 5)
    assert stays == [Stay(2, 0.08, 0.06, pytest.approx(0.01), pytest.approx(0.03 + 0.05)), Stay(1, 0.05, 0.05, 0.0, 0)]
    assert [stay.fall for stay in stays] == [pytest.approx(0.02), 0.0]
    assert stays_in_layer([], [], []) == []
    assert stays_in_layer([0.1], [0.1], [0.1]) == [], "at its depth the layer is left"
    with pytest.raises(InputError, match="wanted as many of each"):
        stays_in_layer([0.1], [], [])
    with pytest.raises(InputError, match="1 rises and 0 errors"):
        least_after(0.1, [0.0], [], 0.2)
    assert least_after(0.1, [0.0, 0.0], [0.2, 0.0], 0.5) == pytest.approx(-0.1)
    assert least_after(0.1, [0.0, 0.3], [0.2, 0.0], 0.5) == pytest.approx(-0.1), "raised again by the second"
    assert least_after(0.0, [0.2], [0.1], 0.5) == 0.0, "at 0 the condition asks for no more than 0"
