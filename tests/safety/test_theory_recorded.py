"""The margin by norms from transitions: what it promises about h, and what it is made of."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.safety.node_steps import asked, latent_at, state_at

from safedpa.dynamics import PhysicsModel, load_model
from safedpa.errors import InputError
from safedpa.robots.car.barriers import car_barriers
from safedpa.safety import FilterSettings, MarginCalibration, one_step_errors, parse_settings
from safedpa.safety.node import SafetyFilterNode
from safedpa.safety.settings import write_settings
from safedpa.safety.theory_recorded import own_errors, recorded_bound

Values = NDArray[np.float64]
FOOTPRINT = (0.08, 0.40, 0.12)
MODEL = load_model("car")
SETTINGS = FilterSettings()


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
    told = [bound.constants[f"scale.{name}"] for name in MODEL.system.state_names]
    assert told == pytest.approx(scale.tolist(), rel=1e-12)


def test_a_robot_without_such_barriers_has_no_such_margin() -> None:
    pendulum = load_model("pendulum")
    assert recorded_bound(pendulum, SETTINGS, drawn(3, (0.0,) * 4), np.ones(3, bool), 0.99).margins == {}


def test_too_few_transitions_are_refused() -> None:
    with pytest.raises(InputError, match="record more"):
        recorded_bound(MODEL, SETTINGS, drawn(150, (0.01, 0.01, 0.01, 0.01)), np.ones(150, bool), 0.99)


CALIBRATION = MarginCalibration(
    {"obstacle": 0.02, "field": 0.03}, 0.99, 1000, "2026-11-21", "f", theorem={"obstacle": 0.05, "field": 0.06}
)


def test_the_setting_chooses_the_margin() -> None:
    assert CALIBRATION.chosen("conformal") is CALIBRATION
    assert CALIBRATION.chosen("theorem").epsilon == {"obstacle": 0.05, "field": 0.06}
    assert CALIBRATION.chosen(0.04).epsilon == {"obstacle": 0.04, "field": 0.04}


def test_a_theorem_that_was_not_measured_is_not_replaced_by_something_else() -> None:
    for theorem in ({}, {"obstacle": 0.05}):
        with pytest.raises(InputError, match="safedpa calibrate"):
            dataclasses.replace(CALIBRATION, theorem=theorem).chosen("theorem")


def test_all_tables_are_kept_in_the_file(tmp_path: Path) -> None:
    whole = dataclasses.replace(CALIBRATION, constants={"step": 1.5}, covered={"theorem.obstacle": 0.995})
    whole.save(tmp_path / "margin.toml")
    assert MarginCalibration.load(tmp_path / "margin.toml") == whole
    with pytest.raises(InputError, match=r"theorem\.obstacle: got -1"):
        dataclasses.replace(whole, theorem={"obstacle": -1.0})


@pytest.mark.parametrize("margin", ["conformal", "theorem", 0.03])
def test_the_setting_is_kept_in_its_file(margin: str | float) -> None:
    assert parse_settings(write_settings(FilterSettings(margin=margin))).margin == margin


@pytest.mark.parametrize(("margin", "message"), [("theorm", "theorem"), (-0.1, "margin"), (float("nan"), "margin")])
def test_wrong_margins_are_refused(margin: str | float, message: str) -> None:
    with pytest.raises(InputError, match=message):
        FilterSettings(margin=margin)


def test_the_filters_node_uses_the_chosen_margin(car: PhysicsModel) -> None:
    from safedpa.dynamics import fingerprint

    calibration = dataclasses.replace(CALIBRATION, fingerprint=fingerprint(car))
    for margin, wanted in (("conformal", 0.03), ("theorem", 0.06), (0.07, 0.07)):
        node = SafetyFilterNode(car, FilterSettings(margin=margin), calibration)
        state = state_at(0)
        assert asked(node, state, latent_at(state, car)).margin == wanted, "the widest of all kinds"
    with pytest.raises(InputError, match="theorem"):
        SafetyFilterNode(car, FilterSettings(margin="theorem"))
