"""f and g of networks by C are those of NumPy, to the last bit."""

import itertools
import shutil
import threading
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safedpa.dynamics import LearnedBase, load_model
from safedpa.networks import LearnedNetworks, Weights
from safedpa.networks.frame import Frame

if shutil.which("cc") is None:
    pytest.skip("no C compiler", allow_module_level=True)

NAMES = ("car_learned", "car_fix", "pendulum_learned", "pendulum_mix", "point_learned", "point_fix_45")


def shipped(name: str) -> Weights:
    base = load_model(name).base
    assert isinstance(base, LearnedBase)
    return base.weights


def by_numpy(weights: Weights, frame: Frame | None = None) -> LearnedNetworks:
    """Networks that were made where compiling is forbidden."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SAFEDPA_COMPILE", "0")
        networks = LearnedNetworks(weights, frame)
        assert networks.compiled is None
    return networks


def compiled(weights: Weights, frame: Frame | None = None) -> LearnedNetworks:
    networks = LearnedNetworks(weights, frame)
    networks.wait_for_compiler()
    return networks


PAIRS = {name: (compiled(shipped(name)), by_numpy(shipped(name))) for name in NAMES}


@given(st.sampled_from(NAMES), st.integers(0, 2**32 - 1), st.sampled_from((0.0, 1e-4, 1.0, 30.0, 1e5)))
@settings(max_examples=150)
def test_compiled_networks_have_the_bits_of_numpy(name: str, seed: int, size: float) -> None:
    ours, numpy = PAIRS[name]
    described, draw = ours.description, np.random.default_rng(seed)
    state = (size * draw.normal(size=len(described.states))).tolist()
    latent = (size * draw.normal(size=described.latents)).tolist()
    assert ours.compiled is not None
    assert ours.row_of_one(state, latent) == numpy.row_of_one(state, latent)


@pytest.mark.parametrize("units", [16, 24, 40, 100, 130])
def test_layers_of_any_width_have_the_bits_of_numpy(units: int) -> None:
    """By C or, where no product of C has NumPy's bits, by NumPy."""
    weights, draw = shipped("car_learned"), np.random.default_rng(units)
    tensors = {}
    for network, outputs in (("f", 4), ("g", 8)):
        widths = (7, units, units, outputs)
        for layer, (before, after) in enumerate(itertools.pairwise(widths)):
            tensors[f"{network}.{layer}.weight"] = draw.normal(size=(after, before), scale=0.3)
            tensors[f"{network}.{layer}.bias"] = draw.normal(size=after, scale=0.1)
    own = weights.with_tensors(tensors)
    ours, numpy = compiled(own), by_numpy(own)
    for state, latent in draw.normal(size=(200, 2, 4)).tolist():
        assert ours.row_of_one(state, latent) == numpy.row_of_one(state, latent)


def test_features_that_read_something_else_later_are_not_those_recorded() -> None:
    """A robot's own frame is recorded; what it reads from outside is looked at before each use."""
    gain = [1.0]

    def features(state: Sequence[Any], operations: Any) -> list[Any]:
        return [gain[0] * operations.cos(state[2]), operations.sin(state[2]), state[3]]

    weights = shipped("car_learned")
    frame = Frame(("a", "b", "c"), features, None, None)
    ours, numpy = compiled(weights, frame), by_numpy(weights, frame)
    state, latent = [0.1, 0.2, 0.3, 1.0], [0.1, 0.2, 0.3, 0.4]
    first = ours.row_of_one(state, latent)
    assert ours.compiled is not None
    assert first == numpy.row_of_one(state, latent)
    gain[0] = 2.0
    assert ours.compiled is None
    assert ours.row_of_one(state, latent) == numpy.row_of_one(state, latent) != first


def test_features_that_are_no_equations_are_computed_by_python() -> None:
    def features(state: Sequence[Any], operations: Any) -> list[Any]:
        return [operations.cos(state[2]), operations.sin(state[2]), state[3] if state[3] > 0.0 else -state[3]]

    ours = compiled(shipped("car_learned"), Frame(("a", "b", "c"), features, None, None))
    assert ours.compiled is None
    latent = [0.1, 0.2, 0.3, 0.4]
    assert ours.row_of_one([0.0, 0.0, 0.3, 1.0], latent) == ours.row_of_one([0.0, 0.0, 0.3, -1.0], latent)


def test_networks_that_overflow_are_computed_by_numpy() -> None:
    """C has no answer for infinity: both are as NumPy has them."""
    weights = shipped("pendulum_fix_45")
    huge = weights.with_tensors(
        {"f.0.weight": 1e30 * weights["f.0.weight"], "f.1.weight": 1e30 * weights["f.1.weight"]}
    )
    ours, numpy = compiled(huge), by_numpy(huge)
    with np.errstate(all="ignore"):
        for state in ([0.0, 0.0], [0.3, 1.0], [1.0, 1e9]):
            np.testing.assert_array_equal(ours.row_of_one(state, []), numpy.row_of_one(state, []))


def test_threads_that_share_networks_get_the_answers_of_their_own_states() -> None:
    ours, numpy = PAIRS["car_learned"]
    states = np.random.default_rng(4).normal(size=(64, 2, 4)).tolist()
    wanted = [numpy.row_of_one(*each) for each in states]
    wrong: list[int] = []

    def ask() -> None:
        for _ in range(20):
            wrong.extend(i for i, each in enumerate(states) if ours.row_of_one(*each) != wanted[i])

    threads = [threading.Thread(target=ask) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []
