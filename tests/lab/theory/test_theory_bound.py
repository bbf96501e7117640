"""The bound of the theory is never exceeded, is enough as a margin, and no part of it can be left out."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as some
from numpy.typing import NDArray

from safedpa.errors import InputError
from safedpa.networks import Layer, dense_stack, frame_of
from safedpa.robots.car.barriers.obstacles import braking_of, car_barriers, largest_gradients
from safedpa.safety import FilterSettings, FunctionBarrier, SafetyFilter
from safedpa_lab.theory.bound import ErrorConstants, barrier_error_bound, scaled_gradient
from safedpa_lab.theory.measure import affine_parts, error_constants, largest_slope, lipschitz_bound

Values = NDArray[np.float64]
seeds = some.integers(0, 2**32 - 1)
NONE = {"f": 0.0, "g": 0.0, "remainder": 0.0, "latent": 0.0, "lipschitz_f": 0.0, "lipschitz_g": 0.0}


def network(random: np.random.Generator, inputs: int, outputs: int, depth: int) -> list[Layer]:
    widths = [inputs, *random.integers(1, 9, depth - 1).tolist(), outputs]
    return [Layer(random.normal(size=(after, before)), random.normal(size=after)) for before, after in pairwise(widths)]


@given(seeds, some.integers(1, 4), some.integers(1, 3), some.integers(1, 3), some.integers(1, 4))
@settings(max_examples=150, deadline=None)
def test_no_step_of_a_random_system_exceeds_the_bound(seed: int, states: int, actions: int, latents: int, depth: int):
    """Truth: another random network of the environment, plus a part that is not affine in the action."""
    random = np.random.default_rng(seed)
    f, g = (network(random, states + latents, rows, depth) for rows in (states, states * actions))
    f_true, g_true = (network(random, states + latents, rows, 2) for rows in (states, states * actions))
    mu = network(random, latents, latents, 2)
    x, e = random.normal(size=(20, states)), random.normal(size=(20, latents))
    z = dense_stack(e, mu, "relu")
    deployed = z + random.normal(size=z.shape) * random.exponential(size=(20, 1))
    u, p = random.uniform(-1, 1, (20, actions)), random.normal(size=(20, states))
    r = 0.1 * random.normal(size=(20, states))

    def parts(nets: tuple[list[Layer], list[Layer]], about: Values) -> tuple[Values, Values]:
        seen = np.concatenate([x, about], axis=1)
        first, second = (dense_stack(seen, net, "relu") for net in nets)
        return first, second.reshape(20, states, actions)

    (F, G), (F_deployed, G_deployed), (F_true, G_true) = (
        parts((f, g), z),
        parts((f, g), deployed),
        parts((f_true, g_true), e),
    )
    truth = F_true + np.einsum("nsa,na->ns", G_true, u) + r
    expected = F_deployed + np.einsum("nsa,na->ns", G_deployed, u)
    inputs = range(states, states + latents)
    constants = ErrorConstants(
        f=float(np.abs(F_true - F).max()), g=float(np.abs(G_true - G).max()), remainder=float(np.abs(r).max()),
        latent=float(np.abs(deployed - z).sum(axis=1).max()), lipschitz_f=lipschitz_bound(f, inputs),
        lipschitz_g=lipschitz_bound(g, inputs),
    )  # fmt: skip
    error = np.abs(((truth - expected) * p).sum(axis=1))
    assert (error <= barrier_error_bound(p, constants, u) * (1 + 1e-9) + 1e-12).all()


@given(seeds, some.integers(1, 4), some.integers(1, 5), some.integers(1, 4))
@settings(max_examples=150, deadline=None)
def test_no_slope_and_no_chord_is_steeper_than_the_lipschitz_bound(seed: int, depth: int, inputs: int, latents: int):
    random = np.random.default_rng(seed)
    layers = network(random, inputs + latents, 3, depth)
    chosen = range(inputs, inputs + latents)
    above = lipschitz_bound(layers, chosen)
    samples = random.normal(size=(30, inputs + latents))
    assert largest_slope(layers, samples, chosen) <= above * (1 + 1e-9)
    moved = samples.copy()
    moved[:, inputs:] += random.normal(size=(30, latents))
    rise = np.abs(dense_stack(moved, layers, "relu") - dense_stack(samples, layers, "relu")).max(axis=1)
    run = np.abs(moved - samples)[:, inputs:].sum(axis=1)
    assert (rise <= above * run * (1 + 1e-9) + 1e-12).all()


@given(seeds)
@settings(max_examples=50, deadline=None)
def test_the_largest_slope_is_that_of_central_differences(seed: int) -> None:
    random = np.random.default_rng(seed)
    layers = network(random, 4, 3, 3)
    sample = random.normal(size=(1, 4))
    step = 1e-6
    differences = [
        (dense_stack(sample + shift, layers, "relu") - dense_stack(sample - shift, layers, "relu")) / (2 * step)
        for shift in step * np.eye(4)[2:]
    ]
    assert largest_slope(layers, sample, [2, 3]) == pytest.approx(np.abs(differences).max(), rel=1e-4, abs=1e-6)


def test_the_lipschitz_bound_is_the_least_of_the_norms_and_a_linear_network_reaches_it() -> None:
    layers = [Layer(np.array([[5.0, 1.0, -3.0], [7.0, 2.0, 0.5]]), np.zeros(2))]
    assert lipschitz_bound(layers, [1, 2]) == 3.0
    assert largest_slope(layers, np.zeros((1, 3)), [1, 2]) == 3.0
    # Entries of one sign in a chain: the product of absolute values is exact, and norms are not below it.
    layers = [Layer(np.array([[1.0], [1.0]]), np.ones(2)), Layer(np.array([[1.0, 1.0]]), np.zeros(1))]
    assert lipschitz_bound(layers, [0]) == pytest.approx(2.0)
    assert largest_slope(layers, np.zeros((1, 1)), [0]) == pytest.approx(2.0)


def test_without_layers_or_inputs_there_is_no_constant() -> None:
    chain = [Layer(np.array([[1.0], [1.0]]), np.ones(2))]
    for layers, inputs in (([], [0]), (chain, [])):
        with pytest.raises(InputError, match="wanted one of each"):
            lipschitz_bound(layers, inputs)


def test_cancelling_weights_are_bounded_by_the_spectral_norm_and_the_sum_of_a_gradient_is_no_norm() -> None:
    """A rotation between two layers: absolute values and row sums lose sqrt(2), the 2-norm nothing."""
    turn = np.array([[1.0, 1.0], [-1.0, 1.0]]) / np.sqrt(2)
    chain = [Layer(np.array([[1.0], [0.0]]), np.zeros(2)), *[Layer(turn, np.zeros(2))] * 6]
    assert lipschitz_bound([*chain, Layer(np.array([[1.0, 0.0]]), np.zeros(1))], [0]) == pytest.approx(1.0)
    # p'1 = 0 for p = (1, -1), and the errors (0.1, -0.1) still move h by 0.2, as far as the bound says.
    error = np.array([0.1, -0.1])
    assert bound([1.0, -1.0], [0.0], f=0.1) == pytest.approx(error @ [1.0, -1.0])


def bound(gradient: list[float], action: list[float], **constants: float) -> float:
    return float(barrier_error_bound(gradient, ErrorConstants(**{**NONE, **constants}), action))


def test_each_constant_alone_is_reached_by_some_system_and_terms_add() -> None:
    """Every term with the factor |p|_1 = 3 and |u|_1 = 1.5: the worst case has equality: none can be dropped."""
    p, u = [2.0, -1.0], [1.0, -0.5]
    signs = np.sign(p)
    assert bound(p, u, f=0.1) == pytest.approx(np.dot(p, 0.1 * signs))
    assert bound(p, u, g=0.1) == pytest.approx(np.dot(p, 0.1 * np.outer(signs, np.sign(u)) @ u))
    assert bound(p, u, remainder=0.1) == pytest.approx(np.dot(p, 0.1 * signs))
    assert bound(p, u, latent=0.2, lipschitz_f=5.0) == pytest.approx(np.dot(p, 5.0 * 0.2 * signs))
    slope = 5.0 * np.outer(signs, np.sign(u))
    assert bound(p, u, latent=0.2, lipschitz_g=5.0) == pytest.approx(np.dot(p, 0.2 * slope @ u))
    whole = bound([1.0], [-2.0], f=1.0, g=10.0, remainder=100.0, latent=1.0, lipschitz_f=1000.0, lipschitz_g=10000.0)
    assert whole == pytest.approx(1.0 + 20.0 + 100.0 + 1000.0 + 20000.0)


@pytest.mark.parametrize("name", list(NONE))
@pytest.mark.parametrize("value", [-1e-9, np.nan, np.inf])
def test_constants_that_are_none_are_refused(name: str, value: float) -> None:
    with pytest.raises(InputError, match=name):
        ErrorConstants(**{**NONE, name: value})


@given(seeds)
@settings(max_examples=50, deadline=None)
def test_a_scaled_gradient_gives_the_same_change_of_h(seed: int) -> None:
    random = np.random.default_rng(seed)
    state, p, v = random.normal(size=4), random.normal(size=4), random.normal(size=4)
    scale = random.uniform(0.01, 2.0, 4)
    frame = frame_of("car")
    change = frame.world_increment(state, scale * v)
    assert scaled_gradient(p, state, frame, scale) @ v == pytest.approx(p @ change)


@given(seeds, some.integers(1, 3), some.integers(1, 4))
@settings(max_examples=50, deadline=None)
def test_affine_parts_are_found_and_the_rest_is_the_remainder(seed: int, actions: int, states: int) -> None:
    random = np.random.default_rng(seed)
    u = random.uniform(-1, 1, (5, 2 * actions + 3, actions))
    f, g = random.normal(size=(5, states)), random.normal(size=(5, states, actions))
    affine = f[:, None] + np.einsum("nsa,nka->nks", g, u)
    found_f, found_g, remainder = affine_parts(u, affine)
    assert found_f == pytest.approx(f)
    assert found_g == pytest.approx(g)
    assert remainder.max() < 1e-9
    bent = affine + (u**2).sum(axis=-1)[..., None]
    found_f, found_g, remainder = affine_parts(u, bent)
    again = found_f[:, None] + np.einsum("nsa,nka->nks", found_g, u)
    assert remainder == pytest.approx(np.abs(bent - again).max(axis=(1, 2)))
    assert remainder.max() > 1e-6


def test_constants_at_a_coverage_hold_together_in_that_share_of_new_states() -> None:
    """Four independent errors: without the correction by Bonferroni 4 % of the states would miss one of them."""
    random = np.random.default_rng(5)
    kinds = random.uniform(size=(2, 4, 20_000))
    names = ("f", "g", "remainder", "latent")
    lipschitz = {"f": (2.0, 1.0), "g": (3.0, 1.5)}
    constants = error_constants(dict(zip(names, kinds[0], strict=True)), lipschitz, 0.99)
    missed = np.zeros(20_000, bool)
    for name, fresh in zip(names, kinds[1], strict=True):
        missed |= fresh > getattr(constants, name)
    assert 0.985 < 1.0 - missed.mean() < 0.995
    assert (constants.lipschitz_f, constants.lipschitz_g) == (2.0, 3.0)


def test_without_a_coverage_the_largest_errors_count_and_of_no_sample_no_slope_is_known() -> None:
    errors = {name: np.array([0.1, 0.3, 0.2]) for name in ("f", "g", "remainder", "latent")}
    constants = error_constants(errors, {"f": (0.0, 0.0), "g": (0.0, 0.0)})
    assert (constants.f, constants.g, constants.remainder, constants.latent) == (0.3, 0.3, 0.3, 0.3)
    with pytest.raises(InputError, match="got 3 states"):
        error_constants(errors, {"f": (0.0, 0.0), "g": (0.0, 0.0)}, 0.9)
    layers = [Layer(np.array([[2.0, -3.0]]), np.zeros(1))]
    assert largest_slope(layers, np.zeros((1, 2)), [0]) == 2.0
    assert largest_slope(layers, np.zeros((1, 2)), [0, 1]) == 3.0
    with pytest.raises(InputError, match=r"^samples: got none, wanted at least one"):
        largest_slope(layers, np.zeros((0, 2)), [0])


SCALE = np.array([0.03, 0.01, 0.02, 0.1])


@given(some.integers(0, 2**32 - 1), some.floats(0.05, 1.0), some.floats(0.05, 1.0))
@settings(max_examples=60, deadline=None)
def test_sampled_gradients_stay_below_the_largest(seed: int, rear: float, front: float) -> None:
    """Also where the gradient belongs to the state after the step, and the frame to the one before."""
    random = np.random.default_rng(seed)
    chosen, footprint = FilterSettings.for_robot("car"), (rear, front, 0.2)
    limits = largest_gradients(chosen, footprint, SCALE)
    obstacles = np.column_stack([random.uniform(-3, 3, (20, 2)), random.uniform(0.1, 0.4, 20)])
    for _ in range(20):
        before, after = random.uniform(
            (-3, -3, -np.pi, chosen.barrier("speed_low")), (3, 3, np.pi, chosen.barrier("speed_high")), (2, 4)
        )
        for part in car_barriers(chosen, footprint, obstacles, (-4, 4, -4, 4)):
            p = scaled_gradient(part.h_and_grad(after)[1], before, frame_of("car"), SCALE)
            assert np.abs(p).sum(axis=1).max() <= limits[part.kind] * (1 + 1e-9)


def test_the_formula_is_not_far_above_what_occurs() -> None:
    random = np.random.default_rng(1)
    chosen, footprint = FilterSettings.for_robot("car"), (0.08, 0.4, 0.12)
    limits = largest_gradients(chosen, footprint, SCALE)
    largest = dict.fromkeys(limits, 0.0)
    for _ in range(3000):
        state = random.uniform((-3, -3, -np.pi, 1.5), (3, 3, np.pi, chosen.barrier("speed_high")))
        for part in car_barriers(chosen, footprint, [(2.0, 0.0, 0.3)], (-4, 4, -4, 4)):
            p = scaled_gradient(part.h_and_grad(state)[1], state, frame_of("car"), SCALE)
            largest[part.kind] = max(largest[part.kind], float(np.abs(p).sum(axis=1).max()))
    assert all(largest[kind] > 0.85 * limits[kind] for kind in limits)


def test_the_arm_is_the_longer_end_of_what_is_swept() -> None:
    """Behind it reaches as far as the stopping distance of the way back, in front as that of the way forth."""
    for chosen, footprint in (
        (FilterSettings.for_robot("car").with_barriers(speed_low=-2.0, speed_high=0.2), (0.5, 0.1, 0.2)),
        (FilterSettings.for_robot("car").with_barriers(speed_low=0.1), (0.1, 0.6, 0.2)),
        (FilterSettings.for_robot("car").with_barriers(speed_low=0.1, speed_high=0.2), (0.6, 0.1, 0.2)),
        (FilterSettings.for_robot("car").with_barriers(speed_low=-2.0, speed_high=-0.1), (0.1, 0.9, 0.2)),
    ):
        rear, front, _ = footprint
        stop = braking_of(chosen).distance
        slowest, fastest = chosen.barrier("speed_low"), chosen.barrier("speed_high")
        arm = max(rear - min(stop(slowest), 0.0), front + max(stop(fastest), 0.0))
        slope = max((stop(at + 1e-6) - stop(at - 1e-6)) / 2e-6 for at in (slowest, fastest))
        body = np.hypot(0.03, 0.01) + np.hypot(arm * 0.02, slope * 0.1)
        found = largest_gradients(chosen, footprint, SCALE)
        assert found == {"obstacle": pytest.approx(body), "field": pytest.approx(body), "speed": 0.1}


def test_a_wrong_footprint_is_refused() -> None:
    with pytest.raises(InputError, match="footprint"):
        largest_gradients(FilterSettings.for_robot("car"), (0.1, np.nan, 0.1), SCALE)


ETA = 0.3


SLOPE = np.array([0.8, -0.5])
"""Of mixed signs: its sum, 0.3, is much less than its 1-norm, 1.3."""
CONSTANTS = ErrorConstants(f=0.004, g=0.006, remainder=0.002, latent=0.5, lipschitz_f=0.01, lipschitz_g=0.004)
G = np.diag([0.1, 0.1])


def h(x: Values) -> float:
    return float(1.0 - SLOPE @ x)


def learned(x: Values) -> tuple[Values, Values]:
    return 0.98 * x, G


def worst_truth(x: Values, a: Values) -> Values:
    """Every error at its bound, in the direction that lowers h most."""
    f, g = learned(x)
    return f + g @ a + np.sign(SLOPE) * CONSTANTS.of_step(np.abs(a).sum())


def least_residual(epsilon: float, seed: int, steps: int = 60) -> tuple[float, float]:
    """The least h(x[t+1]) - (1 - eta) h(x[t]) and the least h over a drive that requests to leave the set."""
    chosen = FilterSettings(action_low=(-1.0, -1.0), action_high=(1.0, 1.0), eta=ETA, epsilon=epsilon)
    safe = SafetyFilter(learned, [FunctionBarrier(h, lambda x: -SLOPE)], chosen)
    random = np.random.default_rng(seed)
    x, residual, least = random.uniform(-0.5, 0.5, 2), np.inf, np.inf
    for _ in range(steps):
        nominal = np.sign(SLOPE) + 0.3 * random.normal(size=2)
        verdict = safe.decide(x, np.clip(nominal, -1.0, 1.0))
        following = worst_truth(x, verdict.action)
        residual = min(residual, h(following) - (1.0 - ETA) * h(x))
        x, least = following, min(least, h(following))
    return residual, least


def enough() -> float:
    return float(barrier_error_bound(SLOPE, CONSTANTS, np.ones(2)))


@given(some.integers(0, 10_000))
@settings(max_examples=15, deadline=None)
def test_the_condition_holds_for_the_truth_and_the_set_is_kept(seed: int) -> None:
    residual, least = least_residual(enough(), seed)
    assert residual >= -1e-4  # the settings' slack tolerance
    assert least >= 0.0


@pytest.mark.parametrize(
    "epsilon",
    [
        0.0,
        abs(SLOPE.sum()) * CONSTANTS.of_step(2.0),  # p'1 in place of |p|_1
        1.3 * (CONSTANTS.f + 2.0 * CONSTANTS.g + CONSTANTS.remainder),  # without the latent's error
        1.3 * (CONSTANTS.f + CONSTANTS.remainder + CONSTANTS.lipschitz_f * CONSTANTS.latent),  # without those of G
    ],
)
def test_with_less_margin_the_truth_breaks_the_condition(epsilon: float) -> None:
    """Epsilon taken away instead of added would be less still: settings refuse it."""
    assert min(least_residual(epsilon, seed)[0] for seed in range(3)) < -1e-3


def test_the_set_itself_is_left_without_a_margin() -> None:
    assert min(least_residual(0.0, seed)[1] for seed in range(3)) < 0.0
