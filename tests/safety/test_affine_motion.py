"""A learned model's motion from known f and g beside its recorded equations, which are the reference: the same bits."""

from __future__ import annotations

from functools import cache
from math import isfinite

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safedpa.dynamics import LearnedBase, PhysicsModel, Setting, load_model
from safedpa.effects import effect
from safedpa.robots.car.barriers import car_barriers
from safedpa.safety import FilterSettings, Prediction, SafetyFilter
from safedpa.safety.affine_motion import AffineMotion

NAMES = ("car_learned", "car_fix", "pendulum_learned", "point_learned")
GIVEN = {"car_learned": 4, "car_fix": 0, "pendulum_learned": 2, "point_learned": 2}


@cache
def recorded(name: str) -> tuple[PhysicsModel, Prediction]:
    """A model and its prediction, asked often enough for its equations to be recorded."""
    model = load_model(name)
    prediction = Prediction.of_model(model)
    state, action = (0.1,) * len(model.system.state_names), (0.1,) * len(model.system.action_names)
    for _ in range(300):
        prediction.following(state, action, None, None)
        prediction.slopes_of_one(state, action, None, None)
    assert model.straight(model.period) is not None
    assert model.straight_tangent() is not None
    return model, prediction


@settings(max_examples=60, deadline=None)
@given(st.sampled_from(NAMES), st.integers(0, 2**32 - 1), st.sampled_from((0.01, 1.0, 30.0, 1e4)), st.booleans())
def test_the_same_bits_as_the_recorded_equations(name: str, seed: int, size: float, own: bool) -> None:
    model, prediction = recorded(name)
    draw = np.random.default_rng(seed)
    state = tuple((size * draw.normal(size=len(model.system.state_names))).tolist())
    latent = None if own else tuple(draw.normal(size=GIVEN[name]).tolist())
    motion = prediction.affine_motion(state, latent)
    assert motion is not None
    for _ in range(3):
        action = tuple((size * draw.normal(size=len(model.system.action_names))).tolist())
        assert motion.after(action) == prediction.following(state, action, latent, None)
        assert motion.after(list(action)) == motion.after(action)
        assert motion.slopes() == prediction.slopes_of_one(state, action, latent, None)


def test_only_of_models_whose_free_parameters_are_the_latent() -> None:
    learned = load_model("car_learned")
    fixed = learned.with_settings({path: Setting(0.1) for path in learned.latent_names[:1]})
    free = learned.with_settings({"base.wheelbase": Setting(0.3, free=True)})
    dragged = learned.with_effect(effect("car", "quadratic_drag"), {})
    state = (0.1, 0.2, 0.3, 0.4)
    for other in (fixed, free, dragged, load_model("car")):
        assert Prediction.of_model(other).affine_motion(state, tuple(other.latent.tolist())) is None
    assert Prediction(lambda x: (x, np.eye(4))).affine_motion(state, None) is None
    prediction = Prediction.of_model(learned)
    assert prediction.affine_motion(state, None) is not None
    assert prediction.affine_motion(state, (0.1,)) is None
    assert prediction.affine_motion((*state, 0.5), None) is None


def test_numbers_beyond_single_precision_are_no_motion_that_is_believed() -> None:
    """As before: networks that overflow predict infinity or NaN, and the filter brakes."""
    model, options = load_model("car_learned"), FilterSettings()
    safe = SafetyFilter(
        Prediction.of_model(model), car_barriers(options, (0.08, 0.4, 0.12), [(2.0, 0.0, 0.3)]), options
    )
    with np.errstate(all="ignore"):
        verdict = safe.decide([0.0, 0.0, 0.0, 0.5], [0.5, 0.0], [1e39, 0.0, 0.0, 0.0])
    assert verdict.status.value == "fallback"
    assert "no finite number for any action" in verdict.reason
    assert isfinite(verdict.h_next)


def test_what_is_known_of_one_state_is_kept_for_it_alone() -> None:
    base = load_model("car_learned").base
    assert isinstance(base, LearnedBase)
    state, latent = (0.1, 0.2, 0.3, 0.4), (0.1, 0.1, 0.1, 0.1)
    first = base.known_at(state, latent)
    assert base.known_at(state, latent) is first
    assert base.known_of_one(*state, *latent) is first
    f, g = base.networks.increment_of_one(state, latent)
    assert first == [*f, *(slope for row in g for slope in row)]
    for other in (((0.1, 0.2, 0.3, 0.5), latent), (state, (0.1, 0.1, 0.1, 0.2))):
        assert base.known_at(*other) != first


@pytest.mark.parametrize("actions", [1, 3])
def test_the_formula(actions: int) -> None:
    """x + period (f + g a) / trained period, in double precision."""
    draw = np.random.default_rng(actions)
    x, f, g, a = (draw.normal(size=shape) for shape in (2, 2, (2, actions), actions))
    motion = AffineMotion(tuple(x.tolist()), [*f.tolist(), *g.ravel().tolist()], 0.1, 0.05)
    np.testing.assert_allclose(motion.after(a.tolist()), x + 2.0 * (f + g @ a), rtol=1e-14)
    np.testing.assert_allclose(motion.slopes(), 2.0 * g, rtol=1e-14)


def test_once_recorded_a_model_is_asked_by_its_recorded_equations_alone() -> None:
    model = load_model("car")
    prediction = Prediction.of_model(model)
    state, action, latent = (0.1, 0.2, 0.3, 0.4), (0.5, 0.1), (0.5, 0.5)
    for _ in range(200):
        before = (
            prediction.following(state, action, latent, None),
            prediction.slopes_of_one(state, action, latent, None),
        )

    def refused(*given: object, **named: object) -> object:
        raise AssertionError((given, named))

    vars(model).update(advance=refused, slopes=refused, straight=refused, straight_tangent=refused)
    assert prediction.following(state, action, latent, None) == pytest.approx(before[0], rel=1e-12)
    np.testing.assert_allclose(prediction.slopes_of_one(state, action, latent, None), before[1], rtol=1e-9)
