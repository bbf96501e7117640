"""Straight-line functions that stand in a module of their own are those that recording gives, number by number."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from safedpa.dynamics import PhysicsModel, load_model
from safedpa.dynamics.base import AbstractBase
from safedpa.dynamics.settings import Setting
from safedpa.dynamics.written_ahead import text_key, written_ahead
from safedpa.robots.car import write_steps
from safedpa.robots.car import written_steps as written
from safedpa.robots.car.write_steps import written_steps

MODULE = written.__name__


def _asked(model: PhysicsModel) -> PhysicsModel:
    """Asked often enough to have been recorded."""
    for _ in range(200):
        model._straight.floats(model.period)
    return model


def _functions(model: PhysicsModel) -> list[Callable[..., Any] | None]:
    _asked(model)
    return [model._straight.floats(model.period), model._straight.tangent(model.period), model.straight_sensitivity]


def test_what_was_written_is_what_recording_gives_today() -> None:
    source = Path(write_steps.__file__).with_name("written_steps.py")
    assert source.read_text(encoding="utf-8") == write_steps.text(), "run python -m safedpa.robots.car.write_steps"


@pytest.mark.parametrize("name", ["car", "car_measured"])
def test_a_shipped_car_takes_what_was_written_and_computes_the_same(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    ahead = _functions(load_model(name))
    assert all(one is None or one in written.WRITTEN.values() for one in ahead)
    monkeypatch.setattr(type(load_model(name).base), "written", "")
    made = _functions(load_model(name))
    assert [one is None for one in made] == [one is None for one in ahead] == [False, False, name == "car_measured"]
    random = np.random.default_rng(11)
    low, high = [-9.0, -9.0, -4.0, -1.0, -0.7, -0.5], [9.0, 9.0, 4.0, 2.0, 2.2, 0.5]
    latents = len(load_model(name).latent_names)
    for _ in range(300):
        drawn = random.uniform(low, high).tolist()
        asked = drawn[:4], drawn[4:], random.uniform(0.0, 1.0, latents).tolist(), 0.0
        for new, old in zip(ahead, made, strict=True):
            assert (new is None and old is None) or new(*asked) == old(*asked)  # type: ignore[misc]


def test_any_other_car_is_recorded() -> None:
    model = load_model("car")
    other = model.with_settings({"base.wheelbase": Setting(0.31)})
    assert written_ahead(MODULE, model.straight_texts()[0]) is not None
    assert all(written_ahead(MODULE, text) is None for text in other.straight_texts())
    assert all(one not in written.WRITTEN.values() for one in _functions(other))
    assert all(one not in written.WRITTEN.values() for one in _functions(model.with_period(0.04)))


def test_numbers_that_python_refuses_are_refused_there_too() -> None:
    step, tangent = (written_ahead(MODULE, text) for text in load_model("car").straight_texts()[:2])
    for one in (step, tangent):
        assert one is not None
        for state, latent, words in (
            ((0.0, 0.0, 0.0), (0.0, 0.0), "not enough values to unpack"),
            ((0.0,) * 5, (0.0, 0.0), "too many values to unpack"),
            ((0.0,) * 4, (), "not enough values to unpack"),
            ((0.0, 0.0, np.inf, 1.0), (0.0, 0.0), "math domain error|finite input"),
        ):
            with pytest.raises(ValueError, match=words):
                one(state, (1.0, 0.0), latent, 0.0)
        with pytest.raises(ZeroDivisionError):
            one((0.0,) * 4, (1.0, 0.0), (-1.0, 0.0), 0.0)
        assert one((0.0,) * 4, {"a": 1.0, "b": 0.1}.values(), [0.5, 0.5], 0.0)


def test_nothing_is_looked_for_where_no_module_is_named() -> None:
    assert AbstractBase.written == ""
    assert written_ahead("", load_model("car").straight_texts()[0]) is None


def test_networks_are_not_written_ahead() -> None:
    assert load_model("car_learned").straight_texts() == ()
    with pytest.raises(ValueError, match="car_learned: got equations that are no plain arithmetic"):
        written_steps("x", "y", {"car_learned": load_model("car_learned")})


def test_the_key_tells_texts_apart() -> None:
    assert text_key("a") != text_key("b")
    assert len(text_key("a")) == 32
