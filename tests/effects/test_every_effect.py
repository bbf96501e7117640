"""Laws that hold for every effect of the library."""

import runpy
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from safedpa.dynamics import AbstractBase, PhysicsModel, Setting
from safedpa.effects import AbstractEffect, effects_of
from safedpa.robots.car.dynamics.kinematic_bicycle import KinematicBicycle
from safedpa.robots.pendulum.rigid_pendulum import RigidPendulum
from safedpa.robots.point.point_mass import PointMass

# by runpy, which does not make it known to the tests of the whole library
AXIS = runpy.run_path(str(Path(__file__).with_name("axis_robot.py")))
SHIPPED = [*effects_of("car").values(), *effects_of("pendulum").values(), *effects_of("point").values()]
ALL = [*SHIPPED, *AXIS["EFFECTS"]]
EVERY = pytest.mark.parametrize("item", ALL, ids=lambda item: f"{item.robot}-{item.name}")
FEW = settings(max_examples=8, deadline=None)
FEWER = settings(max_examples=4, deadline=None)
"""A slope by torch takes a tenth of a second."""
TICKS = 4

BASES: dict[str, tuple[AbstractBase, dict[str, float]]] = {
    "target_speed": (KinematicBicycle(), {"wheelbase": 0.32, "speed_gain": 4.0, "acceleration_limit": 5.0}),
    "throttle": (KinematicBicycle("throttle"), {"wheelbase": 0.32, "drive_gain": 8.0}),
    "torque": (RigidPendulum(), {"length": 0.5, "mass": 0.6, "gravity": 9.81}),
    "thrust": (PointMass(), {"mass": 0.5}),
    "axis": (AXIS["Axis"](), {}),
}
PERIODS = {"target_speed": 0.05, "throttle": 0.05, "torque": 0.01, "thrust": 0.02, "axis": 0.05}
STATE_SCALE = {
    "car": np.array([5.0, 5.0, 3.0, 4.0]), "pendulum": np.array([4.0, 8.0]),
    "point": np.array([5.0, 5.0, 3.0, 2.0, 2.0]), "recovery_axis": np.array([3.0, 2.0]),
}  # fmt: skip
ACTION_SCALE = {"target_speed": np.array([4.0, 0.5]), "throttle": np.array([1.0, 0.5]), "torque": np.array([5.0])}
ACTION_SCALE["axis"] = np.array([1.0, 12.0])
ACTION_SCALE["thrust"] = np.array([2.0, 3.0])
MIRROR_STATE = {"car": np.array([1.0, -1.0, -1.0, 1.0]), "pendulum": np.array([-1.0, -1.0])}
MIRROR_STATE["point"] = np.array([1.0, -1.0, -1.0, 1.0, -1.0])
MIRROR_ACTION = {"car": np.array([1.0, -1.0]), "pendulum": np.array([-1.0])}
MIRROR_ACTION["point"] = np.array([1.0, -1.0])

# thousandths: zeros and coincidences are met, but no width of 1e-290 that lies below every tolerance
shares = st.integers(-1000, 1000).map(lambda thousandths: thousandths / 1000)


def drives_of(*items: AbstractEffect) -> list[str]:
    """The drives for which all these effects have a meaning."""
    if items[0].robot == "recovery_axis":
        return ["axis"]
    drives = {"pendulum": ["torque"], "point": ["thrust"], "car": ["target_speed", "throttle"]}[items[0].robot]
    needs = {name for item in items for name in item.needs}
    return [drive for drive in drives if needs <= {drive}]


def base_model(drive: str) -> PhysicsModel:
    base, values = BASES[drive]
    return PhysicsModel(base, (), {f"base.{n}": Setting(v) for n, v in values.items()}, PERIODS[drive])


@st.composite
def values_of(draw: st.DrawFn, item: AbstractEffect) -> dict[str, float]:
    return {p.name: p.low + (p.high - p.low) * abs(draw(shares)) for p in item.parameters}


@st.composite
def situations(draw: st.DrawFn, item: AbstractEffect) -> tuple[str, np.ndarray, np.ndarray]:
    """A drive, a state and an action for each of a few ticks."""
    drive = draw(st.sampled_from(drives_of(item)))
    state_scale, action_scale = STATE_SCALE[item.robot], ACTION_SCALE[drive]
    state = np.array([draw(shares) for _ in state_scale]) * state_scale
    return drive, state, (np.array([[draw(shares) for _ in action_scale] for _ in range(TICKS)]) * action_scale)


def rollout(model: PhysicsModel, state: Any, actions: Any, latent: Any = None) -> Any:
    """The state after the actions (ticks, ..., actions), from actuators settled at the first."""
    memory = model.initial_memory(actions[0])
    for tick, action in enumerate(actions):
        state, memory = model.advance(state, action, memory, latent, time=tick * model.period)
    return state


def with_free(model: PhysicsModel, item: AbstractEffect, values: dict[str, float]) -> PhysicsModel:
    return model.with_effect(item, {name: Setting(value, free=True) for name, value in values.items()})


@EVERY
def test_declares_itself(item: AbstractEffect) -> None:
    assert item.equation
    assert item.signature
    assert item.source
    assert item.parameters
    names = [parameter.name for parameter in item.parameters]
    assert len(set(names)) == len(names)
    assert set(item.mirrored) <= set(names)
    assert any(parameter.neutral is not None for parameter in item.parameters)


@pytest.mark.long
@EVERY
@FEW
@given(data=st.data())
def test_floats_numpy_and_torch_agree(item: AbstractEffect, data: st.DataObject) -> None:
    import torch

    rows = [data.draw(values_of(item)) for _ in range(2)]
    drive, state, actions = data.draw(situations(item))
    model = with_free(base_model(drive), item, rows[0])
    latent = np.array([list(row.values()) for row in rows])
    states, many = np.stack([state, -state]), np.stack([actions, -actions], axis=1)
    single = np.stack([rollout(model, states[i], many[:, i], latent[i]) for i in range(2)])
    batch = rollout(model, states, many, latent)
    tensors = rollout(model, *(torch.as_tensor(array) for array in (states, many, latent)))
    np.testing.assert_allclose(batch, single, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(tensors.numpy(), single, rtol=1e-9, atol=1e-9)


@pytest.mark.long
@EVERY
@FEWER
@given(data=st.data())
def test_forward_mode_complex_step_and_central_differences_agree(item: AbstractEffect, data: st.DataObject) -> None:
    import torch

    drive, state, actions = data.draw(situations(item))
    model = with_free(base_model(drive), item, data.draw(values_of(item)))
    action, memory = actions[-1], model.initial_memory(actions[0])
    assume(smooth_at(model, state, action, memory))
    f, g = model.affine(state, around=action, memory=memory)
    tensors = torch.as_tensor(state), torch.as_tensor(action)
    f_torch, g_torch = model.affine(tensors[0], around=tensors[1], memory=memory)
    np.testing.assert_allclose(g_torch.numpy(), g, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(f_torch.numpy(), f, rtol=1e-9, atol=1e-9)
    f_batch, g_batch = model.affine(state[None], around=action[None], memory=memory)
    np.testing.assert_allclose(g_batch[0], g, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(f_batch[0], f, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(f + g @ action, model.advance(state, action, memory)[0], rtol=1e-12, atol=1e-12)


def smooth_at(model: PhysicsModel, state: np.ndarray, action: np.ndarray, memory: Any) -> bool:
    """Whether no kink (a stop, a limit, a dead zone) lies within the reach of a central difference.

    The difference of the slopes to both sides halves with the step where the model is smooth, and not at a kink. At the
    kink of a slope (throttle |throttle|) the central difference itself still depends on the step.
    """
    middle = model.advance(state, action, memory)[0]
    for index, reach in enumerate(1e-5 * (model.system.action_high - model.system.action_low)):
        bends, slopes = [], []
        for step in (reach, 0.5 * reach):
            nudge = step * np.eye(len(action))[index]
            up, down = (model.advance(state, action + sign * nudge, memory)[0] for sign in (1, -1))
            bends.append((up - 2 * middle + down) / step)
            slopes.append((up - down) / (2 * step))
        if np.abs(bends[0] - 2.0 * bends[1]).max() > 1e-8 or np.abs(slopes[0] - slopes[1]).max() > 1e-7:
            return False
    return True


@pytest.mark.long
@EVERY
@FEW
@given(data=st.data())
def test_neutral_is_exactly_the_model_without(item: AbstractEffect, data: st.DataObject) -> None:
    import torch

    drive, state, actions = data.draw(situations(item))
    values = data.draw(values_of(item))
    neutral = {p.name: values[p.name] if p.neutral is None else p.neutral for p in item.parameters}
    model = with_free(base_model(drive), item, neutral)
    plain = rollout(base_model(drive), state, actions)
    np.testing.assert_array_equal(rollout(model, state, actions), plain)
    batch = rollout(model, state[None], actions[:, None], model.latent[None])
    np.testing.assert_array_equal(batch, rollout(base_model(drive), state[None], actions[:, None]))
    tensors = torch.as_tensor(state[None]), torch.as_tensor(actions[:, None])
    with_it, without = rollout(model, *tensors, torch.as_tensor(model.latent)), rollout(base_model(drive), *tensors)
    assert torch.equal(with_it, without)


@pytest.mark.parametrize("item", [item for item in ALL if item.name != "angle_bias"], ids=lambda item: item.name)
def test_typical_value_changes_something(item: AbstractEffect) -> None:
    """But for the offset of an angle that the axis only integrates."""
    drive = drives_of(item)[0]
    model = with_free(base_model(drive), item, {p.name: p.typical for p in item.parameters})
    rng = np.random.default_rng(0)
    moved = 0.0
    for _ in range(5):
        state = rng.uniform(-1, 1, len(STATE_SCALE[item.robot])) * STATE_SCALE[item.robot]
        actions = rng.uniform(-1, 1, (TICKS, len(ACTION_SCALE[drive]))) * ACTION_SCALE[drive]
        moved = max(moved, np.abs(rollout(model, state, actions) - rollout(base_model(drive), state, actions)).max())
    assert moved > 1e-4


@pytest.mark.long
@pytest.mark.parametrize("item", SHIPPED, ids=lambda item: f"{item.robot}-{item.name}")
@FEW
@given(data=st.data())
def test_left_and_right_are_mirror_images(item: AbstractEffect, data: st.DataObject) -> None:
    drive, state, actions = data.draw(situations(item))
    values = data.draw(values_of(item))
    mirrored = {name: -value if name in item.mirrored else value for name, value in values.items()}
    assume(all(p.low <= mirrored[p.name] <= p.high for p in item.parameters))
    direct = rollout(with_free(base_model(drive), item, values), state, actions)
    flip_state, flip_action = MIRROR_STATE[item.robot], MIRROR_ACTION[item.robot]
    image = rollout(with_free(base_model(drive), item, mirrored), state * flip_state, actions * flip_action)
    np.testing.assert_allclose(image * flip_state, direct, rtol=1e-9, atol=1e-9)


@pytest.mark.long
@EVERY
@FEW
@given(data=st.data())
def test_gradients_are_finite(item: AbstractEffect, data: st.DataObject) -> None:
    import torch

    drive, state, actions = data.draw(situations(item))
    model = with_free(base_model(drive), item, data.draw(values_of(item)))
    inputs = [torch.tensor(a, requires_grad=True) for a in (state, actions, model.latent)]
    rollout(model, *inputs).sum().backward()  # type: ignore[no-untyped-call]
    for tensor in inputs:
        assert tensor.grad is not None
        assert torch.isfinite(tensor.grad).all()


SAME_STAGE = [
    (one, two)
    for one, two in combinations(ALL, 2)
    if (one.robot, one.stage) == (two.robot, two.stage) and drives_of(one, two)
]


@pytest.mark.parametrize(("one", "two"), SAME_STAGE, ids=lambda item: item.name)
def test_order_in_the_file_does_not_matter(one: AbstractEffect, two: AbstractEffect) -> None:
    drive = drives_of(one, two)[0]
    rng = np.random.default_rng(1)
    for _ in range(5):
        state = rng.uniform(-1, 1, len(STATE_SCALE[one.robot])) * STATE_SCALE[one.robot]
        actions = rng.uniform(-1, 1, (TICKS, len(ACTION_SCALE[drive]))) * ACTION_SCALE[drive]
        models = [base_model(drive), base_model(drive)]
        for index, order in enumerate(((one, two), (two, one))):
            for item in order:
                models[index] = with_free(models[index], item, {p.name: p.typical for p in item.parameters})
        np.testing.assert_allclose(*(rollout(model, state, actions) for model in models), rtol=1e-9, atol=1e-9)
