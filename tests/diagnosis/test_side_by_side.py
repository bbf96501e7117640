"""Many models side by side along one straight line, and starts taken out of residuals, against what defines them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from safedpa.compare.side_by_side import SideBySide
from safedpa.diagnosis.fit.elimination import Elimination
from safedpa.dynamics import PhysicsModel, load_model
from safedpa.dynamics.settings import Setting
from safedpa.effects import CommandEffect, effects_of
from safedpa.operations import NUMPY, half_angled

_MODELS = {"car": "car", "throttle": "dart_car", "pendulum": "pendulum", "point": "point"}
_EFFECTS = [
    (robot, name)
    for robot in _MODELS
    for name, item in effects_of(robot).items()
    if not isinstance(item, CommandEffect)
]


def _variants(robot: str, name: str, shares: tuple[float, ...]) -> list[PhysicsModel]:
    """The robot's model with one effect, at several shares of what is ordinary."""
    item = effects_of(robot)[name]
    given = load_model(_MODELS["throttle" if "throttle" in item.needs else robot])
    own = {path: setting for path, setting in given.settings.items() if path[:5] == "base."}
    base = PhysicsModel(given.base, (), own, holds=True)  # as rollouts have it
    numbers = [
        {
            p.name: Setting(float(np.clip(p.start + share * (p.typical - p.start), p.low, p.high)))
            for p in item.parameters
        }
        for share in shares
    ]
    return [base.with_effect(item, own) for own in numbers]


def _drawn(model: PhysicsModel, count: int, seed: int) -> tuple[Any, Any]:
    """States within what is plausible, and actions within their bounds."""
    random = np.random.default_rng(seed)
    low, high = np.maximum(model.system.state_low, -9.0), np.minimum(model.system.state_high, 9.0)
    actions = random.uniform(model.system.action_low, model.system.action_high, (count, len(model.system.action)))
    return random.uniform(low, high, (count, len(low))), actions


@pytest.mark.parametrize(("robot", "name"), _EFFECTS)
def test_side_by_side_is_what_each_model_does(robot: str, name: str) -> None:
    models = _variants(robot, name, (0.0, 0.4, 1.0))
    states, actions = _drawn(models[0], 40, 3)
    found = SideBySide(models).ahead(list(states.T), list(actions.T), 0.05, np.full(40, 2.0))
    table = np.stack([np.broadcast_to(column, (3, 40)) for column in found], axis=-1)
    for model, own in zip(models, table, strict=True):
        wanted, _ = model.advance(states, actions, (), period=0.05, time=2.0)
        np.testing.assert_allclose(own, wanted, rtol=1e-12, atol=1e-12)


def test_rows_may_have_periods_of_their_own() -> None:
    (model,) = _variants("car", "rolling_resistance", (1.0,))
    states, actions = _drawn(model, 30, 4)
    periods = np.linspace(0.01, 0.1, 30)
    found = np.stack(SideBySide([model]).ahead(list(states.T), list(actions.T), periods, np.zeros(30)), axis=-1)
    each = [
        model.advance(*row, (), period=float(period))[0] for *row, period in zip(states, actions, periods, strict=True)
    ]
    np.testing.assert_allclose(found, np.array(each), rtol=1e-12, atol=1e-12)


def test_networks_go_the_other_way_round() -> None:
    """A learned base cannot be recorded: the reference answers, for models with different numbers too."""
    base = load_model("car_learned")
    item = effects_of("car")["quadratic_drag"]
    models = [base.with_effect(item, {"coefficient": Setting(value)}) for value in (0.0, 0.3)]
    states, actions = _drawn(base, 12, 5)
    found = SideBySide(models).ahead(list(states.T), list(actions.T), base.period, np.zeros(12))
    for index, model in enumerate(models):
        wanted, _ = model.advance(states, actions, ())
        own = np.stack([np.broadcast_to(column, (2, 12))[index] for column in found], axis=-1)
        np.testing.assert_allclose(own, wanted, rtol=1e-9, atol=1e-9)


@given(st.floats(-1e4, 1e4))
def test_sine_and_cosine_by_the_half_angle(angle: float) -> None:
    value, table = np.array([angle]), half_angled(NUMPY)
    assert abs(float((table.sin(value) - np.sin(value))[0])) < 1e-15
    assert abs(float((table.cos(value) - np.cos(value))[0])) < 1e-15


@pytest.mark.parametrize("tangent", [0.0, 1.0, -3.0, 1e16, 1e155, -1e200, np.inf, -np.inf])
def test_so_it_is_for_the_angle_of_any_ratio(tangent: float) -> None:
    """Of a robot that stands a ratio of speeds is infinite, and the angle is a right one."""
    table = half_angled(NUMPY)
    angle = table.atan(np.array([tangent]))
    assert abs(float((table.sin(angle) - np.sin(angle))[0])) < 1e-15
    assert abs(float((table.cos(angle) - np.cos(angle))[0])) < 1e-15


def _random_windows(seed: int) -> tuple[Any, ...]:
    random = np.random.default_rng(seed)
    counts = random.choice([0.0, 0.3, 1.0], size=(7, 9, 3), p=[0.1, 0.1, 0.8])
    tangent, residuals = random.normal(size=(7, 9, 3, 3)), random.normal(size=(4, 7, 9, 3))
    return counts, tangent, residuals


@given(arrays(np.float64, 3, elements=st.floats(1e-3, 10.0)), st.integers(0, 100))
def test_what_a_start_explains_is_gone(scale: Any, seed: int) -> None:
    counts, tangent, residuals = _random_windows(seed)
    taken = Elimination(counts, tangent)
    reduced = taken.reduced(np.moveaxis(residuals, 0, -1), scale)
    weight = np.sqrt(counts) / scale
    for window in range(7):
        basis = (tangent[window] * weight[window][..., None]).reshape(-1, 3)
        column = (residuals[0, window] * weight[window]).reshape(-1)
        wanted = column - basis @ np.linalg.lstsq(basis, column, rcond=None)[0]
        np.testing.assert_allclose(reduced[window, :, 0], wanted, atol=1e-6 * np.abs(column).max())


@pytest.mark.parametrize("count", [1, 63, 64, 65, 200])
def test_every_window_is_reduced_by_itself(count: int) -> None:
    random = np.random.default_rng(count)
    counts, tangent = random.uniform(size=(count, 9, 3)), random.normal(size=(count, 9, 3, 3))
    columns, scale = random.normal(size=(count, 9, 3, 4)), np.array([0.1, 1.0, 3.0])
    whole = Elimination(counts, tangent).reduced(columns, scale)
    for window in range(count):
        alone = Elimination(counts[window, None], tangent[window, None]).reduced(columns[window, None], scale)
        np.testing.assert_allclose(whole[window], alone[0], rtol=1e-9, atol=1e-9)


@given(arrays(np.float64, 3, elements=st.floats(1e-3, 10.0)), st.integers(0, 100))
def test_squares_need_no_reduced_column(scale: Any, seed: int) -> None:
    counts, tangent, residuals = _random_windows(seed)
    taken = Elimination(counts, tangent)
    reduced = taken.reduced(np.moveaxis(residuals, 0, -1), scale).reshape(7, 9, 3, 4)
    wanted = (reduced**2).sum(axis=(0, 1)) * scale[:, None] ** 2
    np.testing.assert_allclose(taken.squares(taken.products(residuals), scale), wanted, rtol=1e-9)
