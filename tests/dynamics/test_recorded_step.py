"""A model's straight-line functions against its dictionary-based reference, their slopes, and the compiled steps."""

import copy
import math
import pickle
import shutil
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safedpa.dynamics import PhysicsModel, Setting, load_model
from safedpa.dynamics.recorded_step import record_step, step_texts
from safedpa.dynamics.tangent import complex_step
from safedpa.effects import CommandEffect, Context, Parameter, RateEffect, Stage
from safedpa.effects.library import effects_of
from safedpa.equations.tape import Recorded, Tape
from safedpa.native.steps import compiled_step
from safedpa.operations import COMPLEX, FLOATS, Operations
from safedpa.robots.car.dynamics.kinematic_bicycle import KinematicBicycle

MODELS = ("car", "car_measured", "dart_car", "pendulum", "dfki_pendulum", "point", "car_learned", "pendulum_learned")


def quick(model: PhysicsModel) -> PhysicsModel:
    """The model, after enough steps to have recorded its equations."""
    zeros = np.zeros(len(model.system.state)), np.zeros(len(model.system.action))
    memory = model.initial_memory(zeros[1])
    for _ in range(250):
        model.advance(*zeros, memory, model.latent)
    return model


def reference(model: PhysicsModel) -> PhysicsModel:
    """A copy, which uses the reference implementation for its first two hundred steps."""
    plain = copy.deepcopy(model)
    assert not has_recorded(plain)
    return plain


def has_recorded(model: PhysicsModel) -> bool:
    return model.scalar_step(model.period) is not None


def with_every_effect(robot: str) -> list[PhysicsModel]:
    """The robot's smallest model with each single effect of the library, all its parameters free."""
    plain = {"car": load_model("car"), "pendulum": load_model("pendulum"), "point": load_model("point")}[robot]
    bare = PhysicsModel(plain.base, (), {k: v for k, v in plain.settings.items() if k.startswith("base.")})
    models = []
    for item in effects_of(robot).values():
        if set(item.needs) <= set(bare.system.action_names):
            models.append(bare.with_effect(item, {p.name: Setting(p.start, free=True) for p in item.parameters}))
    return models


ALL = [load_model(name) for name in MODELS]
ALL += [model for robot in ("car", "pendulum", "point") for model in with_every_effect(robot)]


def agree(model: PhysicsModel, draw: np.random.Generator) -> None:
    """Compares four steps and tangents of both implementations from random states."""
    fast, slow, system = model, reference(model), model.system
    state = draw.normal(size=len(system.state)) * draw.choice((0.0, 1e-3, 1.0, 30.0))
    action = draw.uniform(system.action_low, system.action_high) * draw.choice((0.0, 1.0, 1.5))
    parameters = [model.parameters[path] for path in model.latent_names]
    latent = np.array([draw.choice((p.low, p.high, p.start, draw.uniform(p.low, p.high))) for p in parameters])
    ours, theirs = fast.initial_memory(action), slow.initial_memory(action)
    here = there = state
    for step in range(4):
        for got, wanted in zip(
            fast.affine(here, latent, around=action, memory=ours, time=0.1),
            slow.affine(there, latent, around=action, memory=theirs, time=0.1),
            strict=True,
        ):
            # the reference's complex step leaves its square in a value of zero, which the recorded tangent does not
            np.testing.assert_allclose(got, wanted, rtol=0.0, atol=1e-60)
        here, ours = fast.advance(here, action, ours, latent, time=0.1 * step)
        there, theirs = slow.advance(there, action, theirs, latent, time=0.1 * step)
        np.testing.assert_array_equal(here, there)
        assert ours == theirs


@pytest.mark.parametrize(
    "model", ALL, ids=lambda model: "+".join(item.name for item in model.effects) or model.base.kind
)
def test_recorded_and_reference_steps_give_the_same_bits(model: PhysicsModel) -> None:
    quick(model)
    for seed in range(8):
        agree(model, np.random.default_rng(seed))


def test_a_model_returns_its_recorded_step_once_it_has_one() -> None:
    model, delayed = quick(load_model("car_learned")), quick(load_model("dart_car"))
    state, action = np.array([0.1, 0.2, 0.3, 1.0]), np.array([1.0, 0.1])
    step = model.scalar_step(model.period)
    assert step is not None
    assert step(state.tolist(), action.tolist(), model.latent.tolist(), 0.0) == model.step(state, action).tolist()
    assert load_model("car").scalar_step(0.05) is None
    assert (delayed.scalar_step(delayed.period) is None) == bool(delayed.initial_memory(action))


def without_memory(model: PhysicsModel) -> PhysicsModel:
    """The model without effects that have memory: with them, its step is recorded but not returned."""
    at_rest = dict.fromkeys(model.system.action_names, 0.0)
    commands = [item for item in model.effects if isinstance(item, CommandEffect)]
    retained = [item for item in model.effects if item not in commands or item.initial_memory(at_rest) is None]
    names = {"base", *(item.name for item in retained)}
    settings = {path: value for path, value in model.settings.items() if path.split(".")[0] in names}
    return PhysicsModel(model.base, tuple(retained), settings, model.period)


def test_every_equation_of_the_project_can_be_recorded() -> None:
    assert [model.effects for model in map(without_memory, ALL) if not has_recorded(quick(model))] == []


def test_neutral_operations_are_not_recorded() -> None:
    tape = Tape()
    number = Recorded(tape, "s0")
    assert all(each is number for each in (1.0 * number, number * 1.0, number / 1.0))
    others = [number * 2.0, number + 0.0, 1.0 / number, number**1.0, number - 1.0]
    assert [form for _, form, _ in tape.lines] == ["{0} * {1}", "{0} + {1}", "{0} / {1}", "{0} ** {1}", "{0} - {1}"]
    assert all(each is not number for each in others)


CAR = quick(load_model("car"))


@settings(max_examples=60, deadline=None)
@given(numbers=st.lists(st.floats(allow_nan=True, allow_infinity=True), min_size=8, max_size=8))
def test_extreme_numbers_give_the_same_result_recorded_or_not(numbers: list[float]) -> None:
    latent = np.array(numbers[6 : 6 + len(CAR.latent_names)])
    given_to_both = np.array(numbers[:4]), np.array(numbers[4:6]), (), latent
    with np.errstate(all="ignore"):
        np.testing.assert_array_equal(CAR.advance(*given_to_both)[0], reference(CAR).advance(*given_to_both)[0])


class Bump(RateEffect):
    """A user's effect that branches on a number."""

    name, robot, stage = "bump", "car", Stage.RESISTANCE
    equation = signature = source = "one way or the other"
    parameters = (Parameter("size", "m/s2", 0.0, 5.0, 1.0),)

    def modify(self, rates: Any, parameters: Any, context: Context) -> Any:
        if context.state["x"] > 0.0:
            return {**rates, "speed": rates["speed"] - parameters["size"]}
        return rates


def test_a_users_effect_that_branches_acts_on_both_sides() -> None:
    plain = load_model("car")
    base = {k: v for k, v in plain.settings.items() if k.startswith("base.")}
    model = quick(PhysicsModel(plain.base, (Bump(),), {**base, "bump.size": Setting(2.0)}))
    assert not has_recorded(model)
    left, right = (model.step(np.array([x, 0.0, 0.0, 1.0]), np.array([1.0, 0.0]))[3] for x in (-1.0, 1.0))
    assert left - right == pytest.approx(0.1, abs=0.02)


def test_equations_that_branch_are_not_recorded() -> None:
    class Branching(KinematicBicycle):
        def rates(self, state: Any, action: Any, parameters: Any, operations: Any) -> Any:
            found = super().rates(state, action, parameters, operations)
            return {**found, "speed": 0.0 * state["speed"]} if state["x"] > 0.0 else found

    Branching.__module__ = "safedpa.dynamics.branching"  # as if it were the project's own
    plain = load_model("car")
    base = {k: v for k, v in plain.settings.items() if k.startswith("base.")}
    model = quick(PhysicsModel(Branching(), (), base))
    assert not has_recorded(model)
    stopped, moving = (model.step(np.array([x, 0.0, 0.0, 1.0]), np.array([1.5, 0.0]))[3] for x in (1.0, -1.0))
    assert stopped == 1.0 < moving


def test_a_recorded_model_can_be_pickled() -> None:
    model = quick(load_model("car"))
    assert has_recorded(model)
    other = pickle.loads(pickle.dumps(model))
    state, action = np.array([0.1, 0.2, 0.3, 0.4]), np.array([1.0, 0.1])
    assert other.step(state, action).tobytes() == model.step(state, action).tobytes()


BOTH = ("a", "b")


def everything(state: Sequence[Any], action: Sequence[Any], latent: Sequence[Any], time: Any, use: Operations) -> Any:
    """Every function and operator, with and without an entry of the action on either side."""
    x, y = state
    a, b = action
    near, steep = use.clip(a, -0.5, y), use.clip(x, a, a + 2.0)
    return [
        use.sin(x * a) + use.cos(a - b) * b - use.tan(0.3 * b) + a / (2.0 + b * b) - 1.0 / (3.0 + a),
        use.tanh(4.0 * a) + use.exp(a * b) + use.sqrt(2.0 + a * b) + (-a) ** 2 + (+b) * x + (3.0 + a) ** 3,
        use.minimum(a, b) + use.maximum(y, a * a) + use.absolute(a - 0.1) * use.sign(b) + near * steep + x / y,
        use.where(x < y, a * b, b) + use.cos(b) * use.sin(b) + time * use.tanh(900.0 * (2.0 + a)),
        2.0 * x,
    ]


def bent(state: Sequence[Any], action: Sequence[Any], latent: Sequence[Any], time: Any, use: Operations) -> Any:
    """Where ``atan`` is in it, cmath and math differ in the last bit."""
    return [use.atan(action[0] * state[0]) * action[1]]


def recorded_and_reference(equations, state, action):
    made = record_step(equations, (BOTH, BOTH, ()))
    assert made is not None
    step, _, tangent = made
    value, slopes = tangent(state, action, [], 0.5)
    assert value == step(state, action, [], 0.5) == equations(state, action, [], 0.5, FLOATS)
    reference = complex_step(lambda own: [complex(entry) for entry in equations(state, own, [], 0.5, COMPLEX)], action)
    return value, np.array(slopes), reference[1]


SMALL = st.floats(-0.9, 0.9)


@settings(max_examples=200, deadline=None)
@given(st.tuples(SMALL, st.floats(0.1, 0.9)), st.tuples(SMALL, SMALL))
def test_every_rule_gives_the_slopes_of_complex_steps(state: tuple[float, ...], action: tuple[float, ...]) -> None:
    _, slopes, reference = recorded_and_reference(everything, list(state), list(action))
    np.testing.assert_allclose(slopes, reference, rtol=1e-12, atol=1e-12)
    _, slopes, reference = recorded_and_reference(bent, list(state), list(action))
    np.testing.assert_allclose(slopes, reference, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize(("a", "slope"), [(-0.5, 0.0), (-0.6, 0.0), (-0.4, 1.0), (0.5, 0.0), (0.4, 1.0), (0.6, 0.0)])
def test_at_a_bound_clip_has_the_slope_of_the_bound(a: float, slope: float) -> None:
    bounded = lambda state, action, latent, time, use: [use.clip(action[0], -0.5, state[1])]  # noqa: E731
    _, slopes, reference = recorded_and_reference(bounded, [0.0, 0.5], [a, 0.0])
    assert slopes.tolist() == reference.tolist() == [[slope, 0.0]]


@pytest.mark.parametrize("name", ["car", "car_learned", "pendulum", "point", "point_wind", "point_learned"])
def test_recorded_slopes_of_shipped_models_equal_the_reference(name: str) -> None:
    model, draw = load_model(name), np.random.default_rng(0)
    slow = copy.deepcopy(model)  # uses the reference implementation for its first two hundred steps
    model.record_scalar_step()
    tangent = model.scalar_tangent()
    assert tangent is not None
    for _ in range(100):
        state = draw.normal(size=len(model.system.state_names)).tolist()
        action = draw.uniform(-2.0, 2.0, len(model.system.action_names)).tolist()
        reference = slow.control_matrix(np.array(state), model.latent, np.array(action), ())
        # the reference's complex step leaves its square in a slope of zero, which the recorded tangent does not
        slopes = tangent(state, action, model.latent.tolist(), 0.0)[1]
        np.testing.assert_allclose(slopes, reference, rtol=0.0, atol=1e-60)


NUMBERS = st.one_of(st.floats(-30.0, 30.0), st.sampled_from([0.0, -0.0, 1e9, -1e300, 1e308, math.inf, math.nan]))
Arguments = tuple[list[float], list[float], list[float], float]


def made(function: str) -> Any:
    """The function of a source, compiled now."""
    scope: dict[str, Any] = vars(math).copy()
    exec(function, scope)
    return scope.get("step") or scope["tangent"]


def answer(function: Any, arguments: Arguments) -> Any:
    """The result with every bit, or the type of the exception."""
    try:
        return repr(function(*arguments))
    except (ValueError, ArithmeticError) as error:
        return type(error)


@cache
def compiled_and_recorded(name: str) -> tuple[tuple[str, str], tuple[int, int, int], Any]:
    """Source of step and tangent, the numbers of their arguments, and the compiled step."""
    model = load_model(name)
    names = model.system.state_names, model.system.action_names, model.latent_names
    texts = step_texts(model.equations(model.period), names)
    assert texts is not None
    sizes = (len(names[0]), len(names[1]), len(names[2]))
    return texts, sizes, compiled_step(*texts, sizes)


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
@pytest.mark.parametrize("name", ["car", "car_measured", "pendulum", "point", "differential_drive", "dart_car"])
@given(data=st.data())
@settings(deadline=None)
def test_a_compiled_step_equals_the_recorded_one_to_the_last_bit(name: str, data: st.DataObject) -> None:
    texts, sizes, compiled = compiled_and_recorded(name)
    drawn = [data.draw(st.lists(NUMBERS, min_size=size, max_size=size)) for size in sizes]
    arguments = (*drawn, data.draw(NUMBERS))
    for function, text in zip((compiled.step, compiled.tangent), texts, strict=True):
        found, wanted = answer(function, arguments), answer(made(text), arguments)  # type: ignore[arg-type]
        # odd numbers are left to NumPy
        assert found == wanted or found is ArithmeticError
        assert (
            found is not ArithmeticError
            or max(map(abs, [*drawn[0], *drawn[1], *drawn[2]])) >= 1e9
            or "nan" in repr(drawn)
        )


def test_a_model_records_a_step_of_its_own_for_another_period() -> None:
    car = load_model("car")
    other = car.with_period(0.04)
    for _ in range(200):
        used, recorded_now = car.scalar_step(0.05), other.scalar_step(0.04)
    state, action, latent = [0.1, 0.2, 0.3, 1.0], [1.0, 0.1], car.latent.tolist()
    assert used is not None
    assert recorded_now is not None
    assert used(state, action, latent, 0.0) != recorded_now(state, action, latent, 0.0)
