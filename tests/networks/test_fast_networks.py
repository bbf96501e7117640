"""Every fast road of the networks agrees with the one that is written down in torch, in double precision.

The fast roads compute in single precision, of which one unit in the last place is 1.2e-7: they agree to 1e-6 of the
largest number that comes out, not to the last bit.
"""

import copy
import pickle
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safedpa.dynamics import LearnedBase, load_model
from safedpa.errors import InputError
from safedpa.networks import HistoryEncoder, HistoryStreams, LearnedNetworks, Weights

torch = pytest.importorskip("torch")
SHIPPED = ("car_learned", "pendulum_learned", "car_fix", "car_simulated", "pendulum_mix")


def shipped(name: str) -> Weights:
    base = load_model(name).base
    assert isinstance(base, LearnedBase)
    return base.weights


def with_history(weights: Weights, history: int, seed: int) -> Weights:
    """The weights with a history encoder that looks at so many rows."""
    steps = ((history - 8) // 4 + 1 - 8) // 4 + 1
    out = np.random.default_rng(seed).normal(size=(4, 32 * steps), scale=0.2)
    return weights.with_tensors({"phi.out.weight": out}, replace(weights.description, history=history))


def agree(ours: np.ndarray, reference: np.ndarray) -> None:
    """To 1e-6 of the largest entry of each column, or of 1 where that is larger."""
    scale = np.maximum(np.abs(reference).max(axis=0), 1.0)
    assert (np.abs(ours - reference) / scale).max() < 1e-6


def reference_increment(weights: Weights, states: np.ndarray, latents: np.ndarray, actions: np.ndarray) -> np.ndarray:
    from safedpa.networks.tensors import TensorNetworks

    columns = [
        [torch.from_numpy(part[:, index].copy()) for index in range(part.shape[1])]
        for part in (states, latents, actions)
    ]
    return np.stack([change.numpy() for change in TensorNetworks(weights).change(*columns)], axis=1)


@given(st.sampled_from(SHIPPED), st.integers(0, 2**32 - 1), st.integers(1, 300))
@settings(max_examples=15)
def test_f_and_g_agree_with_torch(name, seed, count):
    weights = shipped(name)
    described, draw = weights.description, np.random.default_rng(seed)
    states = draw.normal(size=(count, len(described.states)))
    latents = draw.normal(size=(count, described.latents))
    actions = draw.uniform(-1.0, 1.0, size=(count, len(described.actions)))
    networks, scale = LearnedNetworks(weights), weights["increment_scale"]
    reference = reference_increment(weights, states, latents, actions) / scale
    f, g = networks.increment(states, latents)
    agree((f + np.einsum("nsa,na->ns", g, actions)) / scale, reference)
    f_of_one, g_of_one = networks.increment_of_one(states[0].tolist(), latents[0].tolist())
    agree(((np.array(f_of_one) + np.array(g_of_one) @ actions[0]) / scale)[None], reference[:1])


@given(st.integers(0, 2**32 - 1), st.integers(1, 4), st.sampled_from((36, 41, 50, 52, 63, 100)))
@settings(max_examples=12)
def test_phi_tick_by_tick_agrees_with_torch(random_car_weights, seed, robots, history):
    """From the first row on, over more rows than a history has, for histories that the kernels do and do not divide."""
    from safedpa.networks.reference import reference_latent

    weights = with_history(random_car_weights(seed % 7), history, seed)
    encoder = HistoryEncoder(weights)
    streams = HistoryStreams(encoder, robots)
    rows = np.random.default_rng(seed).normal(size=(robots, history + 40, encoder.row_length))
    for tick in range(rows.shape[1]):
        ours = streams.push(rows[:, tick]).copy()
        if tick % 9 == 0 or tick < 3:
            agree(ours, reference_latent(weights, encoder.padded(rows[:, : tick + 1])))


@pytest.mark.parametrize("name", ["car_learned", "pendulum_learned"])
def test_shipped_phi_agrees_with_torch(name):
    from safedpa.networks.reference import reference_latent

    weights = shipped(name)
    encoder = HistoryEncoder(weights)
    rows = np.random.default_rng(1).normal(size=(40, encoder.length, encoder.row_length))
    reference = reference_latent(weights, rows)
    agree(encoder.encode(rows), reference)
    streams = HistoryStreams(encoder, 40)
    for tick in range(encoder.length):
        newest = streams.push(rows[:, tick])
    agree(newest, reference)


def test_one_robot_of_many_starts_again_alone(random_car_weights):
    encoder = HistoryEncoder(with_history(random_car_weights(3), 52, 3))
    rows = np.random.default_rng(2).normal(size=(3, 90, encoder.row_length))
    streams, alone = HistoryStreams(encoder, 3), HistoryStreams(encoder)
    for tick in range(90):
        if tick == 61:
            streams.reset([1])
        together = streams.push(rows[:, tick]).copy()
        if tick >= 61:
            agree(together[1:2], alone.push(rows[1:2, tick]))
    agree(together[[0, 2]], encoder.encode(rows[[0, 2], -52:]))


def test_a_row_of_plain_numbers_is_the_row_of_arrays():
    draw = np.random.default_rng(3)
    for name in ("car_learned", "pendulum_learned"):
        encoder, described = HistoryEncoder(shipped(name)), shipped(name).description
        states, action = draw.normal(size=(2, len(described.states))), draw.normal(size=len(described.actions))
        one = encoder.row_of_one(states[0].tolist(), action.tolist(), states[1].tolist())
        np.testing.assert_allclose(one, encoder.rows(states, action[None])[0], rtol=1e-12, atol=1e-12)


def test_threads_and_copies_do_not_share_buffers():
    networks = LearnedNetworks(shipped("car_learned"))
    draw = np.random.default_rng(4)
    states, latents = draw.normal(size=(64, 4)).tolist(), draw.normal(size=(64, 4)).tolist()
    expected = [networks.increment_of_one(*pair) for pair in zip(states, latents, strict=True)]
    with ThreadPoolExecutor(4) as pool:
        for _ in range(5):
            assert list(pool.map(networks.increment_of_one, states, latents)) == expected
    for twin in (copy.deepcopy(networks), pickle.loads(pickle.dumps(networks))):
        assert [twin.increment_of_one(*pair) for pair in zip(states, latents, strict=True)] == expected


def test_f_and_g_of_different_depth_are_refused(random_car_weights):
    weights = random_car_weights(1)
    deeper = weights.with_tensors(
        {
            "g.2.weight": np.eye(16), "g.2.bias": np.zeros(16), "g.3.weight": weights["g.2.weight"],
            "g.3.bias": weights["g.2.bias"],
        }
    )  # fmt: skip
    with pytest.raises(InputError, match="f has 3 layers, g has 4; wanted as many"):
        LearnedNetworks(deeper)


@pytest.mark.parametrize("large", [1.0, 1e30, 1e39, float("inf"), float("nan")])
def test_plain_numbers_beyond_single_precision_are_taken_as_arrays_take_them(large):
    networks, state, latent = LearnedNetworks(shipped("car_learned")), (0.1, -0.2, 0.3, 0.4), (large, 0.5, -large, 0.7)
    with np.errstate(all="ignore"):
        expected = networks.increment(np.array([state]), np.array([latent]))
        for plain, array in zip(networks.increment_of_one(state, latent), expected, strict=True):
            if abs(large) < 1e38:
                np.testing.assert_allclose(plain, array[0], rtol=1e-5, atol=1e-5 * large)
            else:
                assert not np.isfinite(plain).any()
                assert not np.isfinite(array).any()
        with pytest.raises(ValueError, match="could not broadcast"):
            networks.increment_of_one(state, latent[:-2])
