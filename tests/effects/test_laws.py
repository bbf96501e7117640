"""Effects with a law: outside a region nothing, inside everything, and slopes in between; the same on every road."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest

from safedpa.dynamics import PhysicsModel, Setting, load_model, parse_model, write_model
from safedpa.effects import Varies, Where, conditioned, effect, effects_of
from safedpa.effects.effects_with_law import may_have_law
from safedpa.effects.law import law_of
from safedpa.errors import ModelFileError

CAR = """
format = 1
robot = "car"
[base]
kind = "kinematic_bicycle"
drive = "speed_servo"
wheelbase = 0.32
speed_gain = 3.0
acceleration_limit = 6.0
"""
FLOOR = """
[[effects]]
name = "rolling_resistance"
where = "x above"
edge = 0.05
deceleration = 0.9
x_above = 1.0
"""
SAG = """
[[effects]]
name = "speed_command_gain"
varies = "gain with time"
gain = 1.0
gain_per_time = -0.004
"""
LAWS = (
    ("rolling_resistance", Where("above", "x", 0.05), {"deceleration": 0.9, "x_above": 1.0}),
    ("rolling_resistance", Where("circle", "", 0.05), {"deceleration": 0.9, "at_x": 1.0, "at_y": 0.0, "radius": 1.0}),
    ("rolling_resistance", Where("strip", "", 0.05), {"deceleration": 0.9, "angle": 0.3, "offset": 1.0,
                                                      "half_width": 0.5}),
    ("steering_gain", Where("between", "abs_speed", 0.05), {"gain": 0.8, "abs_speed_from": 0.5, "abs_speed_to": 1.5}),
    ("steering_gain", Varies("gain", "abs_speed"), {"gain": 1.0, "gain_per_abs_speed": -0.08}),
    ("speed_command_gain", Varies("gain", "time"), {"gain": 1.0, "gain_per_time": -0.004}),
    ("quadratic_drag", Where("below", "time", 0.5), {"coefficient": 0.2, "time_below": 20.0}),
)  # fmt: skip


def car(name=None, law=None, numbers=None, free=False) -> PhysicsModel:
    plain = parse_model(CAR)
    if name is None:
        return plain
    made = conditioned(effect("car", name), law, plain.system)
    return plain.with_effect(made, {key: Setting(value, free) for key, value in numbers.items()})


def step(model, state, action, time=0.0):
    action = np.array(action)
    return model.advance(np.array(state), action, model.initial_memory(action), model.latent, time=time)[0]


@pytest.mark.parametrize(
    ("law", "numbers", "outside", "inside"),
    [
        (Where("above", "x", 0.05), {"x_above": 1.0}, (0.0, 0.0), (2.0, 0.0)),
        (Where("below", "y", 0.05), {"y_below": 1.0}, (0.0, 2.0), (0.0, 0.0)),
        (Where("circle", "", 0.05), {"at_x": 5.0, "at_y": 1.0, "radius": 1.0}, (0.0, 0.0), (5.0, 1.2)),
        (Where("strip", "", 0.05), {"angle": 0.0, "offset": 3.0, "half_width": 0.5}, (0.0, 7.0), (3.0, -7.0)),
    ],
)
def test_a_region_has_the_plain_effect_inside_and_none_outside(law, numbers, outside, inside):
    model = car("rolling_resistance", law, {"deceleration": 0.9, **numbers})
    plain = car().with_effect(effect("car", "rolling_resistance"), {"deceleration": Setting(0.9)})
    for place, same in ((outside, car()), (inside, plain)):
        state = [*place, 0.3, 1.0]
        np.testing.assert_allclose(step(model, state, [1.0, 0.1]), step(same, state, [1.0, 0.1]), atol=1e-9)


def test_a_number_varies_in_proportion_and_stays_within_its_bounds():
    model = car("speed_command_gain", Varies("gain", "time"), {"gain": 1.0, "gain_per_time": -0.004})
    for time, gain in ((0.0, 1.0), (100.0, 0.6), (1e6, 0.1)):
        same = car().with_effect(effect("car", "speed_command_gain"), {"gain": Setting(gain)})
        at, alike = step(model, [0, 0, 0, 1.0], [1.5, 0.0], time), step(same, [0, 0, 0, 1.0], [1.5, 0.0])
        np.testing.assert_allclose(at, alike, atol=5e-5 if time < 1e6 else 1e-9)


def test_a_gain_with_a_law_acts_after_the_lag():
    lag = car().with_effect(effect("car", "steering_lag"), {"time_constant": Setting(0.2)})
    law = Where("above", "abs_speed", 0.01)
    made = conditioned(effect("car", "steering_gain"), law, lag.system)
    model = lag.with_effect(made, {"gain": Setting(0.5), "abs_speed_above": Setting(1.0)})
    state, action = np.array([0.0, 0.0, 0.0, 2.0]), np.array([2.0, 0.2])
    memory = model.initial_memory(np.array([2.0, 0.0]))
    turned, whole = (one.advance(state, action, memory)[0][2] for one in (model, lag))
    assert turned == pytest.approx(0.5 * whole, rel=0.01)


@pytest.mark.parametrize(("name", "law", "numbers"), LAWS)
def test_every_road_says_the_same_and_has_its_slopes(name, law, numbers):
    model = car(name, law, numbers, free=True)
    slow = copy.deepcopy(model)  # takes the road of dictionaries for its first two hundred steps
    random = np.random.default_rng(4)
    for _ in range(250):
        step(model, [0, 0, 0, 1.0], [1.0, 0.1])
    assert model.straight(model.period) is not None
    states = random.uniform([-1, -1, -3, -2], [3, 1, 3, 2], (40, 4))
    actions = random.uniform([-2, -0.5], [2, 0.5], (40, 2))
    batch = model.advance(states, actions, (), model.latent, time=15.0)[0]
    for state, action, many in zip(states, actions, batch, strict=True):
        one = step(model, state, action, 15.0)
        np.testing.assert_array_equal(one, step(slow, state, action, 15.0))
        np.testing.assert_allclose(one, many, rtol=0, atol=1e-12)
        g = model.affine(state, model.latent, around=action, time=15.0)[1]
        nudge = 1e-6 * np.eye(2)
        columns = [(step(model, state, action + e, 15.0) - step(model, state, action - e, 15.0)) / 2e-6 for e in nudge]
        np.testing.assert_allclose(g, np.stack(columns, axis=1), atol=1e-6)


def test_torch_has_gradients_in_border_and_rate():
    torch = pytest.importorskip("torch")
    model = car(*LAWS[0], free=True)
    latent = torch.tensor(model.latent, requires_grad=True)
    state = torch.tensor([[1.0, 0.0, 0.0, 1.5]], dtype=torch.float64)
    model.step(state, torch.tensor([[1.5, 0.0]], dtype=torch.float64), latent)[0, 3].backward()
    assert (latent.grad.abs() > 1e-6).all()


@pytest.mark.parametrize(("name", "law", "numbers"), LAWS)
def test_a_model_file_says_it_and_is_read_back(name, law, numbers):
    model = car(name, law, numbers)
    text = write_model(model)
    again = parse_model(text)
    assert again.effects == model.effects
    assert hash(again.effects) == hash(model.effects)
    assert again.settings == model.settings
    assert write_model(again) == text
    assert pickle.loads(pickle.dumps(model)).effects == model.effects


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            FLOOR.replace("x above", "x abvoe"),
            "rolling_resistance.where: got 'x abvoe', wanted 'VARIABLE above|below|between', say 'x above', or one of circle, strip",  # noqa: E501 - as the page has it, whole
        ),
        (FLOOR.replace("x above", "z above"), "where: got 'z'; known: abs_speed"),
        (FLOOR.replace("edge = 0.05\n", ""), "edge: missing; give the width over which it sets in"),
        (FLOOR.replace("edge = 0.05", "edge = 0.0"), "edge: got 0, wanted a width above 0 m"),
        (FLOOR.replace("x_above = 1.0\n", ""), "x_above: missing; give a number, -10000 to 10000 m"),
        (FLOOR.replace('where = "x above"', "where = 3"), "where: got 3, wanted 'VARIABLE"),
        (FLOOR + 'varies = "deceleration with time"\n', "got 'where' and 'varies'"),
        (FLOOR.replace('where = "x above"\n', ""), "edge: got it without 'where'"),
        (SAG.replace("gain with time", "gain with tide"), "varies: got 'tide'"),
        (SAG.replace("gain with time", "grain with time"), "varies: got 'grain'; did you mean 'gain'?"),
        (SAG.replace("gain with time", "gain"), "varies: got 'gain', wanted 'PARAMETER with VARIABLE'"),
        ('[[effects]]\nname = "steering_lag"\nwhere = "x above"\nedge = 0.1\n', "cannot depend on where and when"),
        ('[[effects]]\nname = "speed_sensor_scale"\nvaries = "scale with time"\n', "cannot depend on where and when"),
    ],
)
def test_a_mistake_is_reported_in_one_line(text, said):
    with pytest.raises(ModelFileError) as error:
        parse_model(CAR + text)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_an_angle_is_no_variable():
    with pytest.raises(ModelFileError, match="got 'yaw'"):
        parse_model(CAR + FLOOR.replace("x above", "yaw above"))


@pytest.mark.parametrize("robot", ["car", "pendulum", "point"])
def test_every_effect_that_may_have_a_law_can_be_asked(robot):
    model = load_model(robot)
    bare = PhysicsModel(model.base, (), {k: v for k, v in model.settings.items() if k.startswith("base.")})
    state, action = np.full(len(bare.system.state), 0.3), np.full(len(bare.system.action), 0.1)
    for item in effects_of(robot).values():
        if not may_have_law(item, bare.system) or not set(item.needs) <= set(bare.system.action_names):
            continue
        for law in (Where("above", "time", 0.5), law_of("varies", f"{item.parameters[0].name} with time", None, "")):
            made = conditioned(item, law, bare.system)
            assert np.isfinite(bare.with_effect(made, {}).step(state, action)).all()


@pytest.mark.parametrize(
    ("name", "law", "numbers", "said"),
    [
        (*LAWS[0], "beyond x = 1.00 m"),
        (*LAWS[1], "inside the circle of 1.00 m about x = 1.00, y = 0.00 m"),
        (*LAWS[3], "where |speed| is between 0.5 and 1.5 m/s"),
        (*LAWS[4], "falls by 8 % with each m/s of |speed|"),
        (*LAWS[5], "falls by 0.4 % a second"),
        (*LAWS[6], "until 20 s"),
    ],
)
def test_a_law_is_described_in_words(name, law, numbers, said):
    model = car(name, law, numbers)
    item = model.effects[0]
    assert item.law.sentence(numbers, item.inner, model.system) == said
