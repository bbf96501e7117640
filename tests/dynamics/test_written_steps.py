"""The steps that stand in a module of their own are what recording the shipped models gives, to the last bit."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from safedpa.dynamics import load_model, shipped_models, written_steps
from safedpa.dynamics.straight import step_texts
from safedpa.dynamics.tangent import written_key
from safedpa.dynamics.write_steps import text

NUMBERS = st.one_of(st.floats(-30.0, 30.0), st.sampled_from([0.0, -0.0, 1e9, -1e300, 1e308, math.inf, math.nan]))
Arguments = tuple[list[float], list[float], list[float], float]


def recorded() -> dict[str, tuple[Any, str]]:
    """Of every function that is written: its model, and its text."""
    found = {}
    for name in shipped_models():
        model = load_model(name)
        names = model.system.state_names, model.system.action_names, model.latent_names
        for kind, function in zip(
            ("step", "tangent"), step_texts(model.equations(model.period), *names) or (), strict=False
        ):
            found[f"{name}_{kind}"] = model, function
    return found


RECORDED = recorded()


def made(function: str) -> Any:
    """The function of a text as Python itself reads it."""
    scope: dict[str, Any] = vars(math).copy()
    exec(function, scope)
    return scope.get("step") or scope["tangent"]


def answer(function: Any, arguments: Arguments) -> Any:
    """What comes out, every bit of it; or what kind of number was refused."""
    try:
        return repr(function(*arguments))
    except (ValueError, ArithmeticError) as error:
        return type(error)


def test_the_module_is_what_its_writer_writes() -> None:
    source = Path(written_steps.__file__).with_name("written_steps.py")
    assert source.read_text(encoding="utf-8") == text(), "run python -m safedpa.dynamics.write_steps"


@pytest.mark.parametrize("name", ["car_step", "car_tangent", "car_measured_step", "pendulum_step", "point_tangent"])
@given(data=st.data())
def test_a_written_step_is_the_recorded_one_to_the_last_bit(name: str, data: st.DataObject) -> None:
    model, function = RECORDED[name]
    sizes = len(model.system.state_names), len(model.system.action_names), len(model.latent_names)
    drawn = [data.draw(st.lists(NUMBERS, min_size=size, max_size=size)) for size in sizes]
    arguments = (*drawn, data.draw(NUMBERS))
    assert answer(written_steps.WRITTEN[written_key(function)], arguments) == answer(made(function), arguments)  # type: ignore[arg-type]


def test_a_model_takes_the_written_step_and_one_with_other_numbers_does_not() -> None:
    car = load_model("car")
    other = car.with_period(0.04)
    for _ in range(200):
        taken, recorded_now = car.straight(0.05), other.straight(0.04)
    assert taken is written_steps.car_step
    assert car.straight_tangent() is written_steps.car_tangent
    assert recorded_now is not None
    assert recorded_now is not taken


def test_a_text_that_differs_by_a_space_is_another() -> None:
    function = RECORDED["car_step"][1]
    assert written_key(function) in written_steps.WRITTEN
    assert written_key(function + " ") not in written_steps.WRITTEN
