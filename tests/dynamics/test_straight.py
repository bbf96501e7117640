"""The straight-line road of a model against the road of dictionaries: equal to the last bit, or not taken at all."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safedpa.dynamics import PhysicsModel, Setting, load_model
from safedpa.effects import CommandEffect, Context, Parameter, RateEffect, Stage
from safedpa.effects.library import effects_of
from safedpa.equations.tape import Recorded, Tape
from safedpa.robots.car.kinematic_bicycle import KinematicBicycle

MODELS = ("car", "car_measured", "dart_car", "pendulum", "dfki_pendulum", "point", "car_learned", "pendulum_learned")


def quick(model: PhysicsModel) -> PhysicsModel:
    """The model, asked often enough to have recorded its equations."""
    zeros = np.zeros(len(model.system.state)), np.zeros(len(model.system.action))
    memory = model.initial_memory(zeros[1])
    for _ in range(250):
        model.advance(*zeros, memory, model.latent)
    return model


def reference(model: PhysicsModel) -> PhysicsModel:
    """A copy, which takes the road of dictionaries for its first two hundred steps."""
    plain = copy.deepcopy(model)
    assert not has_recorded(plain)
    return plain


def has_recorded(model: PhysicsModel) -> bool:
    return model.straight(model.period) is not None


def with_every_effect(robot: str) -> list[PhysicsModel]:
    """The robot's smallest model with each single effect of the library, all its parameters free."""
    plain = {"car": load_model("car"), "pendulum": load_model("pendulum"), "point": load_model("point")}[robot]
    bare = PhysicsModel(plain.base, (), {k: v for k, v in plain.settings.items() if k.startswith("base.")})
    models = []
    for item in effects_of(robot).values():
        if set(item.needs) <= set(bare.system.action_names):
            models.append(bare.with_effect(item, {p.name: Setting(p.start, free=True) for p in item.parameters}))
    return models


ALL = [load_model(name) for name in MODELS] + [
    model for robot in ("car", "pendulum", "point") for model in with_every_effect(robot)
]


def agree(model: PhysicsModel, draw: np.random.Generator) -> None:
    """Four steps and tangents in a row from random numbers, by both roads."""
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
def test_both_roads_give_the_same_bits(model: PhysicsModel) -> None:
    quick(model)
    for seed in range(8):
        agree(model, np.random.default_rng(seed))


def test_a_model_tells_its_straight_step_once_it_has_one() -> None:
    model, delayed = quick(load_model("car_learned")), quick(load_model("dart_car"))
    state, action = np.array([0.1, 0.2, 0.3, 1.0]), np.array([1.0, 0.1])
    step = model.straight(model.period)
    assert step is not None
    assert step(state.tolist(), action.tolist(), model.latent.tolist(), 0.0) == model.step(state, action).tolist()
    assert load_model("car").straight(0.05) is None
    assert (delayed.straight(delayed.period) is None) == bool(delayed.initial_memory(action))


def without_memory(model: PhysicsModel) -> PhysicsModel:
    """The model without effects whose actuators remember: between these its step is recorded, but not handed out."""
    at_rest = dict.fromkeys(model.system.action_names, 0.0)
    commands = [item for item in model.effects if isinstance(item, CommandEffect)]
    kept = [item for item in model.effects if item not in commands or item.initial_memory(at_rest) is None]
    names = {"base", *(item.name for item in kept)}
    settings = {path: value for path, value in model.settings.items() if path.split(".")[0] in names}
    return PhysicsModel(model.base, tuple(kept), settings, model.period)


def test_every_equation_of_the_project_can_be_recorded() -> None:
    assert [model.effects for model in map(without_memory, ALL) if not has_recorded(quick(model))] == []


def test_what_gives_the_same_number_is_not_written_down() -> None:
    tape = Tape()
    number = Recorded(tape, "s0")
    assert all(each is number for each in (1.0 * number, number * 1.0, number / 1.0))
    others = [number * 2.0, number + 0.0, 1.0 / number, number**1.0, number - 1.0]
    assert [form for _, form, _ in tape.lines] == ["{0} * {1}", "{0} + {1}", "{0} / {1}", "{0} ** {1}", "{0} - {1}"]
    assert all(each is not number for each in others)


CAR = quick(load_model("car"))


@settings(max_examples=60, deadline=None)
@given(numbers=st.lists(st.floats(allow_nan=True, allow_infinity=True), min_size=8, max_size=8))
def test_numbers_beyond_all_bounds_end_alike(numbers: list[float]) -> None:
    model = CAR
    state, action, latent = np.array(numbers[:4]), np.array(numbers[4:6]), np.array(numbers[6:8])
    latent = latent[: len(model.latent_names)]
    with np.errstate(all="ignore"):
        np.testing.assert_array_equal(
            model.advance(state, action, (), latent)[0], reference(model).advance(state, action, (), latent)[0]
        )


class Bump(RateEffect):
    """A user's effect that branches on a number, as Python allows."""

    name = "bump"
    robot = "car"
    stage = Stage.RESISTANCE
    equation = "one way or the other"
    parameters = (Parameter("size", "m/s2", 0.0, 5.0, 1.0),)
    signature = "none"
    source = "this test"

    def modify(self, rates: Any, parameters: Any, context: Context) -> Any:
        if context.state["x"] > 0.0:
            return {**rates, "speed": rates["speed"] - parameters["size"]}
        return rates


def test_a_users_effect_that_branches_is_heeded_on_both_sides() -> None:
    plain = load_model("car")
    base = {k: v for k, v in plain.settings.items() if k.startswith("base.")}
    model = quick(PhysicsModel(plain.base, (Bump(),), {**base, "bump.size": Setting(2.0)}))
    assert not has_recorded(model)
    left, right = (model.step(np.array([x, 0.0, 0.0, 1.0]), np.array([1.0, 0.0]))[3] for x in (-1.0, 1.0))
    assert left - right == pytest.approx(0.1, abs=0.02)


def test_a_branch_in_equations_that_are_recorded_is_refused_and_not_guessed() -> None:
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


def test_a_model_that_was_used_travels_to_another_process() -> None:
    model = quick(load_model("car"))
    assert has_recorded(model)
    other = pickle.loads(pickle.dumps(model))
    state, action = np.array([0.1, 0.2, 0.3, 0.4]), np.array([1.0, 0.1])
    assert other.step(state, action).tobytes() == model.step(state, action).tobytes()
