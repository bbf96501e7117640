"""Constants measured on a learned model whose truth is known, and what they promise on fresh states."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as some
from numpy.typing import NDArray

from safedpa.errors import InputError
from safedpa.networks import Description, LearnedNetworks, Weights, dense_stack, frame_of
from safedpa.networks.layers import layers_of
from safedpa.safety.theory_measure import (
    Branches,
    affine_parts,
    error_constants,
    lipschitz_constants,
    measured_errors,
    network_parts,
)

Values = NDArray[np.float64]
STATES, ACTIONS = ("x", "y", "yaw", "speed"), ("target_speed", "steer")


def weights(seed: int, latents: int = 2, width: int = 8) -> Weights:
    random = np.random.default_rng(seed)
    tensors: dict[str, Values] = {}
    for name, outputs in (("f", 4), ("g", 8)):
        for index, (rows, columns) in enumerate(((width, 3 + latents), (width, width), (outputs, width))):
            tensors[f"{name}.{index}.weight"] = random.normal(size=(rows, columns)) / np.sqrt(columns)
            tensors[f"{name}.{index}.bias"] = 0.1 * random.normal(size=rows)
    tensors |= {
        "feature_middle": np.array([0.0, 0.0, 0.7]),
        "feature_scale": np.array([1.0, 1.0, 1.5]),
        "action_middle": np.array([0.7, 0.0]),
        "action_scale": np.array([1.3, 0.34]),
        "increment_scale": np.array([0.03, 0.01, 0.02, 0.1]),
    }
    if latents:
        tensors |= {"latent_low": np.full(latents, -3.0), "latent_high": np.full(latents, 3.0)}
        tensors["latent_nominal"] = np.zeros(latents)
    single = {name: np.asarray(tensor, np.float32) for name, tensor in tensors.items()}
    return Weights(single, Description("car", 0.05, STATES, ACTIONS, latents))


def branches(known: Weights, seed: int, count: int = 60, off: float = 0.3, bend: float = 0.05) -> Branches:
    """The truth: other networks of the latent, and a part that bends with the action."""
    random = np.random.default_rng(seed)
    truth = LearnedNetworks(weights(99, known.description.latents))
    state = random.uniform((-3, -3, -3, -0.5), (3, 3, 3, 2), (count, 4))
    latent = random.normal(size=(count, known.description.latents))
    u = random.uniform(-1, 1, (count, 9, 2))
    F, G = network_parts(truth, state, latent)
    v = F[:, None] + np.einsum("nsa,nka->nks", G, u) + bend * np.sin(3.0 * u[..., :1])
    own = v * known["increment_scale"]
    frame = frame_of("car")
    repeated = np.broadcast_to(state[:, None], own.shape)
    return Branches(
        state=state,
        latent=latent,
        deployed=latent + off * random.normal(size=latent.shape),
        action=known["action_middle"] + u * known["action_scale"],
        following=repeated + frame.world_increment(repeated, own),
    )


@given(some.integers(0, 10_000))
@settings(max_examples=25, deadline=None)
def test_no_measured_step_exceeds_the_bound_of_its_own_constants(seed: int) -> None:
    known = weights(seed)
    networks, seen = LearnedNetworks(known), branches(known, seed)
    errors = measured_errors(networks, seen)
    constants = error_constants(errors, lipschitz_constants(networks, seen))
    assert (errors["step"] <= constants.of_step(errors["effort"]) * (1 + 1e-5)).all()


def test_fresh_steps_are_covered_at_least_as_promised() -> None:
    known = weights(3)
    networks = LearnedNetworks(known)
    first, fresh = branches(known, 1, 1500), branches(known, 2, 1500)
    constants = error_constants(measured_errors(networks, first), lipschitz_constants(networks, first), 0.95)
    later = measured_errors(networks, fresh)
    assert (later["step"] <= constants.of_step(later["effort"])).mean() >= 0.95


def test_a_network_that_is_the_truth_has_no_error_but_the_latents() -> None:
    known = weights(99)
    errors = measured_errors(LearnedNetworks(known), branches(known, 4, off=0.3, bend=0.0))
    for name in ("f", "g", "remainder"):
        assert errors[name].max() < 1e-5
    assert errors["latent"].min() > 0.0
    assert errors["step"].max() > 1e-3  # from the latent alone


def test_the_error_of_the_latent_is_its_sum_over_entries() -> None:
    known = weights(99)
    seen = branches(known, 4)
    moved = Branches(seen.state, seen.latent, seen.latent + np.array([0.25, -0.5]), seen.action, seen.following)
    assert measured_errors(LearnedNetworks(known), moved)["latent"] == pytest.approx(0.75)


def test_each_error_is_the_largest_of_its_entries() -> None:
    known = weights(12)
    networks, seen = LearnedNetworks(known), branches(known, 4)
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


def test_slopes_are_those_at_the_branches_own_states_and_latents() -> None:
    known = weights(5)
    networks, seen = LearnedNetworks(known), branches(known, 1)
    largest = 0.0
    for state, latent in zip(seen.state, seen.deployed, strict=True):
        for entry in range(2):
            moved = np.tile(latent, (2, 1))
            moved[:, entry] += (-1e-3, 1e-3)
            scaled = (frame_of("car").features(state) - known["feature_middle"]) / known["feature_scale"]
            out = dense_stack(np.column_stack([np.tile(scaled, (2, 1)), moved]), layers_of(known.tensors, "f"), "relu")
            largest = max(largest, float(np.abs(out[1] - out[0]).max()) / 2e-3)
    assert lipschitz_constants(networks, seen)["f"][1] == pytest.approx(largest, rel=0.05)


def test_actions_that_do_not_tell_the_parts_apart_are_refused() -> None:
    line = np.tile(np.linspace(-1.0, 1.0, 9)[None, :, None], (2, 1, 2))
    all_ways = np.random.default_rng(0).uniform(-1, 1, (2, 4, 2))
    for action in (line, all_ways[:, :3], np.concatenate([line[:1, :4], all_ways[:1]])):
        with pytest.raises(InputError, match="wanted at least 4 that point all ways"):
            affine_parts(action, np.zeros((*action.shape[:2], 4)))
    assert affine_parts(all_ways, np.ones((2, 4, 4)))[0] == pytest.approx(1.0), "four are enough"


def test_too_few_states_for_a_coverage_are_refused() -> None:
    known = weights(3)
    networks = LearnedNetworks(known)
    errors = measured_errors(networks, branches(known, 1, 60))
    with pytest.raises(InputError, match="got 60 states, too few"):
        error_constants(errors, {"f": (1.0, 1.0), "g": (1.0, 1.0)}, 0.99)
    short = errors | {"f": errors["f"][:10]}
    with pytest.raises(InputError, match="too few"):
        error_constants(short, {"f": (1.0, 1.0), "g": (1.0, 1.0)}, 0.9)


def test_network_parts_predict_what_the_networks_predict() -> None:
    known = weights(7)
    networks, seen = LearnedNetworks(known), branches(known, 1)
    f, g = networks.own_increment(seen.state, seen.latent)
    F, G = network_parts(networks, seen.state, seen.latent)
    u = (seen.action[:, 0] - known["action_middle"]) / known["action_scale"]
    scaled = F + np.einsum("nsa,na->ns", G, u)
    plain = f + np.einsum("nsa,na->ns", g, seen.action[:, 0])
    assert scaled * known["increment_scale"] == pytest.approx(plain, rel=1e-5, abs=1e-7)


def test_slopes_are_found_between_zero_and_the_bound() -> None:
    known = weights(5)
    for upper, seen in lipschitz_constants(LearnedNetworks(known), branches(known, 1)).values():
        assert 0.0 < seen <= upper
    without = weights(5, latents=0)
    assert lipschitz_constants(LearnedNetworks(without), branches(without, 1)) == {"f": (0.0, 0.0), "g": (0.0, 0.0)}


def test_branches_that_do_not_fit_are_refused() -> None:
    seen = branches(weights(1), 1)
    alone = [part[:1] for part in (seen.state, seen.latent, seen.deployed, seen.action, seen.following)]
    assert Branches(*alone).action.shape == (1, 9, 2)
    with pytest.raises(InputError, match="n > 0"):
        Branches(*(part[:0] for part in alone))
    with pytest.raises(InputError, match="deployed"):
        Branches(seen.state, seen.latent, seen.deployed[:5], seen.action, seen.following)
    with pytest.raises(InputError, match="state"):
        Branches(seen.state[:5], seen.latent, seen.deployed, seen.action, seen.following)
