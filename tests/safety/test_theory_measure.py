"""Constants and margins measured on transitions, and what they promise on fresh states."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as some
from numpy.typing import NDArray
from tests.safety.node_steps import asked, latent_at, state_at

from safedpa.calibration.from_recordings import own_errors, recorded_bound
from safedpa.dynamics import PhysicsModel, load_model
from safedpa.errors import InputError
from safedpa.networks import Description, LearnedNetworks, Weights, dense_stack, frame_of
from safedpa.networks.layers import layers_of
from safedpa.robots.car.barriers.obstacles import car_barriers
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety import (
    FilterSettings,
    FunctionBarrier,
    MarginCalibration,
    SafetyFilter,
    one_step_errors,
    parse_settings,
)
from safedpa.safety.settings import write_settings
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
        state=state, latent=latent, deployed=latent + off * random.normal(size=latent.shape),
        action=known["action_middle"] + u * known["action_scale"],
        following=repeated + frame.world_increment(repeated, own),
    )  # fmt: skip


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


def test_a_network_that_is_the_truth_errs_by_the_latents_alone_summed_over_their_entries() -> None:
    known = weights(99)
    errors = measured_errors(LearnedNetworks(known), branches(known, 4, off=0.3, bend=0.0))
    for name in ("f", "g", "remainder"):
        assert errors[name].max() < 1e-5
    assert errors["latent"].min() > 0.0
    assert errors["step"].max() > 1e-3  # from the latent alone
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


def test_too_few_states_or_actions_that_do_not_separate_the_parts_are_refused() -> None:
    line = np.tile(np.linspace(-1.0, 1.0, 9)[None, :, None], (2, 1, 2))
    all_ways = np.random.default_rng(0).uniform(-1, 1, (2, 4, 2))
    for action in (line, all_ways[:, :3], np.concatenate([line[:1, :4], all_ways[:1]])):
        with pytest.raises(InputError, match="wanted at least 4 that point all ways"):
            affine_parts(action, np.zeros((*action.shape[:2], 4)))
    assert affine_parts(all_ways, np.ones((2, 4, 4)))[0] == pytest.approx(1.0), "four are enough"
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


FOOTPRINT = (0.08, 0.40, 0.12)
MODEL = load_model("car")
SETTINGS = FilterSettings.for_robot("car")


@dataclasses.dataclass
class Drawn:
    """Transitions whose true step is the model's, disturbed in its own frame."""

    state: Values
    action: Values
    following: Values
    latent: Values
    footprints: set[tuple[float, ...]]


def drawn(count: int, sizes: tuple[float, ...], seed: int = 0) -> Drawn:
    random = np.random.default_rng(seed)
    state = random.uniform((-3, -3, -np.pi, -0.4), (3, 3, np.pi, 1.8), (count, 4))
    action = random.uniform((-0.6, -0.34), (2.0, 0.34), (count, 2))
    latent = np.tile(MODEL.latent, (count, 1))
    own = random.uniform(-1, 1, (count, 4)) * sizes
    c, s = np.cos(state[:, 2]), np.sin(state[:, 2])
    change = np.column_stack([c * own[:, 0] - s * own[:, 1], s * own[:, 0] + c * own[:, 1], own[:, 2], own[:, 3]])
    return Drawn(state, action, MODEL.step(state, action, latent) + change, latent, {FOOTPRINT})


def test_own_errors_are_the_disturbance() -> None:
    errors = own_errors(MODEL, drawn(200, (0.01, 0.0, 0.02, 0.03)))
    assert np.abs(errors).max(axis=0) == pytest.approx([0.01, 0.0, 0.02, 0.03], rel=0.05, abs=1e-12)


@pytest.mark.long
@pytest.mark.parametrize("sizes", [(0.01, 0.01, 0.0, 0.0), (0.0, 0.0, 0.03, 0.0), (0.0, 0.0, 0.0, 0.1)])
def test_what_it_covers_in_norm_it_covers_in_h(sizes: tuple[float, ...]) -> None:
    """Disturbed in one kind of entry alone, so that a factor that is missing for it shows."""
    found = drawn(6000, sizes)
    used = np.arange(6000) < 4000
    bound = recorded_bound(MODEL, SETTINGS, found, used, 0.99)
    obstacles = np.column_stack([np.random.default_rng(1).uniform(-3, 3, (40, 2)), np.full(40, 0.2)])
    barriers = car_barriers(SETTINGS, FOOTPRINT, obstacles, (-4, 4, -4, 4))
    errors = one_step_errors(MODEL, barriers, found.state, found.action, found.following, found.latent)
    for kind, epsilon in bound.margins.items():
        assert (errors[kind][~used] <= epsilon).mean() >= 0.98
    assert errors["obstacle"].max() > 0.25 * bound.margins["obstacle"]  # no bound without bounds


def test_the_margin_is_the_largest_gradient_times_the_error_of_the_step() -> None:
    bound = recorded_bound(MODEL, SETTINGS, drawn(1200, (0.01, 0.002, 0.02, 0.05)), np.ones(1200, bool), 0.99)
    made_of = bound.constants
    assert set(bound.margins) == {"obstacle", "field", "speed"}
    for kind, margin in bound.margins.items():
        assert margin == pytest.approx(made_of[f"gradient.{kind}"] * made_of["step"])
    assert made_of["gradient.speed"] == made_of["scale.speed"] == pytest.approx(0.05, rel=0.05)
    assert made_of["step"] == pytest.approx(1.0, abs=0.05)


def test_the_longest_footprint_counts() -> None:
    found = drawn(1200, (0.01, 0.002, 0.02, 0.05))
    used = np.ones(1200, bool)
    alone = recorded_bound(MODEL, SETTINGS, found, used, 0.99)
    found.footprints = {FOOTPRINT, (0.08, 1.4, 0.12)}
    both = recorded_bound(MODEL, SETTINGS, found, used, 0.99)
    assert both.margins["obstacle"] > 1.1 * alone.margins["obstacle"]
    assert both.margins["speed"] == alone.margins["speed"]


def test_the_scales_are_those_of_the_first_of_ten_blocks() -> None:
    found = drawn(1200, (0.01, 0.002, 0.02, 0.05))
    bound = recorded_bound(MODEL, SETTINGS, found, np.ones(1200, bool), 0.99)
    errors = np.abs(own_errors(MODEL, found))
    aside = np.concatenate([np.arange(100), np.arange(1000, 1100)])
    scale = np.quantile(errors[aside], 0.99, axis=0)
    reported = [bound.constants[f"scale.{name}"] for name in MODEL.system.state_names]
    assert reported == pytest.approx(scale.tolist(), rel=1e-12)


def test_too_few_transitions_are_refused_and_a_robot_without_such_barriers_has_no_such_margin() -> None:
    pendulum = load_model("pendulum")
    assert recorded_bound(pendulum, SETTINGS, drawn(3, (0.0,) * 4), np.ones(3, bool), 0.99).margins == {}
    with pytest.raises(InputError, match="record more"):
        recorded_bound(MODEL, SETTINGS, drawn(150, (0.01, 0.01, 0.01, 0.01)), np.ones(150, bool), 0.99)


CALIBRATION = MarginCalibration(
    {"obstacle": 0.02, "field": 0.03}, 0.99, 1000, "2026-11-21", "f", theorem={"obstacle": 0.05, "field": 0.06}
)


def test_the_setting_chooses_the_margin_and_a_theorem_that_was_not_measured_is_not_replaced() -> None:
    assert CALIBRATION.select("conformal") is CALIBRATION
    assert CALIBRATION.select("theorem").epsilon == {"obstacle": 0.05, "field": 0.06}
    assert CALIBRATION.select(0.04).epsilon == {"obstacle": 0.04, "field": 0.04}
    for theorem in ({}, {"obstacle": 0.05}):
        with pytest.raises(InputError, match="safedpa calibrate"):
            dataclasses.replace(CALIBRATION, theorem=theorem).select("theorem")


def test_all_tables_are_kept_in_the_file(tmp_path: Path) -> None:
    whole = dataclasses.replace(CALIBRATION, constants={"step": 1.5}, covered={"theorem.obstacle": 0.995})
    whole.save(tmp_path / "margin.toml")
    assert MarginCalibration.load(tmp_path / "margin.toml") == whole
    with pytest.raises(InputError, match=r"theorem\.obstacle: got -1"):
        dataclasses.replace(whole, theorem={"obstacle": -1.0})


@pytest.mark.parametrize("margin", ["conformal", "theorem", 0.03])
def test_the_setting_is_kept_in_its_file(margin: str | float) -> None:
    assert parse_settings(write_settings(FilterSettings.for_robot("car", margin=margin))).margin == margin


@pytest.mark.parametrize(("margin", "message"), [("theorm", "theorem"), (-0.1, "margin"), (float("nan"), "margin")])
def test_wrong_margins_are_refused(margin: str | float, message: str) -> None:
    with pytest.raises(InputError, match=message):
        FilterSettings.for_robot("car", margin=margin)


def test_the_filters_node_uses_the_chosen_margin(car: PhysicsModel) -> None:
    from safedpa.dynamics import fingerprint

    calibration = dataclasses.replace(CALIBRATION, fingerprint=fingerprint(car))
    for margin, wanted in (("conformal", 0.03), ("theorem", 0.06), (0.07, 0.07)):
        node = SafetyFilterNode(car, FilterSettings.for_robot("car", margin=margin), calibration)
        state = state_at(0)
        assert asked(node, state, latent_at(state, car)).margin == wanted, "the widest of all kinds"
    with pytest.raises(InputError, match="theorem"):
        SafetyFilterNode(car, FilterSettings.for_robot("car", margin="theorem"))


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
