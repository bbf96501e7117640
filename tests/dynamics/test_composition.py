"""Composition of base and effects: integration, tangents, batches, latents, actuators, tracked points."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safedpa.diagnosis.diagnose import library_for
from safedpa.dynamics import PhysicsModel, Setting, fingerprint, load_model, parse_model, write_model
from safedpa.effects import CommandEffect, Context, Parameter, RateEffect, Stage, effect
from safedpa.errors import ModelFileError
from safedpa.robots.car.dynamics.kinematic_bicycle import KinematicBicycle
from safedpa.robots.pendulum.rigid_pendulum import RigidPendulum
from safedpa.safety.prediction.predictor import Prediction


def pendulum(period: float) -> PhysicsModel:
    values = {"base.length": Setting(0.5), "base.mass": Setting(1.0), "base.gravity": Setting(9.81)}
    model = PhysicsModel(RigidPendulum(), (), values, period)
    return model.with_effect(effect("pendulum", "viscous_friction"), {"coefficient": Setting(0.1)})


def car() -> PhysicsModel:
    values = {"base.wheelbase": Setting(0.32), "base.speed_gain": Setting(4.0), "base.acceleration_limit": Setting(5.0)}
    model = PhysicsModel(KinematicBicycle(), (), values)
    for name, own in {
        "towed_load": {"mass_ratio": Setting(0.0, free=True), "deceleration": Setting(2.5)},
        "quadratic_drag": {"coefficient": Setting(0.1, free=True)},
        "steering_lag": {"time_constant": Setting(0.12)}, "understeer": {"gradient": Setting(0.02, free=True)},
    }.items():  # fmt: skip
        model = model.with_effect(effect("car", name), own)
    return model


def end_after_one_second(period: float) -> np.ndarray:
    model, state = pendulum(period), np.array([2.0, 0.5])
    for _ in range(round(1.0 / period)):
        state = model.step(state, np.array([0.7]))
    return state


def test_integration_converges_with_order_four() -> None:
    exact = end_after_one_second(1 / 2048)
    errors = [np.linalg.norm(end_after_one_second(1 / n) - exact) for n in (16, 32, 64, 128)]
    assert np.all(np.abs(np.log2(np.array(errors[:-1]) / np.array(errors[1:])) - 4.0) < 0.35)


@settings(max_examples=50, deadline=None)
@given(
    state=st.tuples(st.floats(-4, 4), st.floats(-4, 4), st.floats(-3, 3), st.floats(0.0, 1.0)),
    target=st.floats(0.3, 0.9),
    other=st.floats(0.3, 0.9),
)
def test_affine_is_exact_where_the_model_is_affine(state: tuple[float, ...], target: float, other: float) -> None:
    model, now = load_model("car"), np.array(state)
    # steer held: position is bent by nothing, and the servo is linear below its limit; friction is not
    free_of_load = PhysicsModel(model.base, (), {k: v for k, v in model.settings.items() if k.startswith("base.")})
    around, action = np.array([target, 0.1]), np.array([other, 0.1])
    f, g = free_of_load.affine(now, around=around)
    after = free_of_load.step(now, action)
    np.testing.assert_allclose((f + g @ action)[2:], after[2:], atol=1e-9)
    np.testing.assert_allclose(f + g @ around, free_of_load.step(now, around), atol=1e-12)


def test_affine_is_exact_for_the_pendulum_over_the_whole_range_of_small_steps() -> None:
    model = pendulum(0.01)
    state = np.array([0.4, -0.3])
    f, g = model.affine(state)
    for torque in (-5.0, 0.0, 5.0):
        # what is left is the bend of gravity within one step: sin(angle) after 0.01 s
        np.testing.assert_allclose(f + g @ [torque], model.step(state, np.array([torque])), atol=2e-8)


def test_tangent_misses_by_the_square_of_the_distance() -> None:
    model, state, around = car(), np.array([0.0, 0.0, 0.2, 3.0]), np.array([3.0, 0.25])
    f, g = model.affine(state, around=around)
    errors = []
    for share in (1.0, 0.5, 0.25):
        action = around + share * np.array([0.0, 0.2])
        memory = model.initial_memory(around)
        errors.append(np.abs(f + g @ action - model.advance(state, action, memory)[0]).max())
    assert errors[0] > 1e-4
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.2)
    assert errors[1] / errors[2] == pytest.approx(4.0, rel=0.2)


def kinds(kind: str, array: np.ndarray) -> Any:
    return array if kind == "numpy" else pytest.importorskip("torch").as_tensor(array)


STATES = np.random.default_rng(0).uniform(-1, 1, (3, 4))
ACTIONS = np.random.default_rng(1).uniform(-0.3, 0.3, (3, 2))
LATENTS = np.random.default_rng(2).uniform(0.0, 0.05, (3, 3))


@pytest.mark.parametrize("kind", ["numpy", "torch"])
@pytest.mark.parametrize("state", [STATES, STATES[0]], ids=["states", "one_state"])
@pytest.mark.parametrize("action", [ACTIONS, ACTIONS[0]], ids=["actions", "one_action"])
@pytest.mark.parametrize("latent", [LATENTS, LATENTS[0], None], ids=["latents", "one_latent", "no_latent"])
def test_leading_axes_broadcast(kind: str, state: np.ndarray, action: np.ndarray, latent: np.ndarray | None) -> None:
    model = car()
    given_latent = None if latent is None else kinds(kind, latent)
    after = np.asarray(model.step(kinds(kind, state), kinds(kind, action), given_latent))
    f, g = model.affine(kinds(kind, state), given_latent, around=kinds(kind, action))
    leading = np.broadcast_shapes(state.shape[:-1], action.shape[:-1], () if latent is None else latent.shape[:-1])
    assert (after.shape, tuple(f.shape)) == ((*leading, 4), (*leading, 4))
    assert tuple(g.shape) == (*leading, 4, 2)
    for index in np.ndindex(leading):
        one = [None if a is None else (a[index] if a.ndim == 2 else a) for a in (state, action, latent)]
        np.testing.assert_allclose(after[index], model.step(*one), atol=1e-12)
        f_one, g_one = model.affine(one[0], one[2], around=one[1])
        np.testing.assert_allclose(np.asarray(f)[index], f_one, atol=1e-6)
        np.testing.assert_allclose(np.asarray(g)[index], g_one, atol=1e-6)


def test_two_leading_axes_and_default_around() -> None:
    torch = pytest.importorskip("torch")
    states = np.tile(STATES, (2, 1, 1))
    for array in (states, torch.as_tensor(states)):
        f, g = car().affine(array)
        assert (tuple(f.shape), tuple(g.shape)) == ((2, 3, 4), (2, 3, 4, 2))


def test_single_precision_stays_single() -> None:
    torch = pytest.importorskip("torch")
    states, actions = torch.as_tensor(STATES, dtype=torch.float32), torch.as_tensor(ACTIONS, dtype=torch.float32)
    model = car()
    assert model.step(states, actions).dtype == torch.float32
    assert model.step(states, actions, torch.as_tensor(LATENTS[0], dtype=torch.float32)).dtype == torch.float32
    assert model.step(states, actions, LATENTS).dtype == torch.float32
    assert model.affine(states, around=actions)[1].dtype == torch.float32
    assert np.abs(model.step(states, actions).numpy() - model.step(STATES, ACTIONS)).max() < 1e-5


def test_numpy_state_with_torch_latent_is_refused() -> None:
    torch = pytest.importorskip("torch")
    with pytest.raises(TypeError, match="wanted one kind"):
        car().step(STATES[0], ACTIONS[0], torch.zeros(3))


def test_latent_of_the_wrong_length_names_the_entries() -> None:
    with pytest.raises(ModelFileError, match=r"latent: got 2 entries, wanted 3: towed_load.mass_ratio, quadratic_drag"):
        car().step(STATES[0], ACTIONS[0], np.zeros(2))


def test_a_latent_and_equal_settings_give_the_same_step() -> None:
    model, latent = car(), np.array([0.3, 0.2, 0.01])
    assert model.latent_names == ("towed_load.mass_ratio", "quadratic_drag.coefficient", "understeer.gradient")
    by_settings = model.with_latent(latent)
    np.testing.assert_array_equal(by_settings.latent, latent)
    np.testing.assert_array_equal(by_settings.step(STATES[0], ACTIONS[0]), model.step(STATES[0], ACTIONS[0], latent))


def test_memory_carries_on_between_steps() -> None:
    model = car()
    memory = model.initial_memory(np.array([1.0, 0.0]))
    first, memory = model.advance(STATES[0], np.array([1.0, 0.3]), memory)
    lagging = model.affine(first, around=np.array([1.0, 0.3]), memory=memory)
    settled = model.affine(first, around=np.array([1.0, 0.3]))
    assert abs(first[3]) > 0.5, "of a car that stands no steering turns anything"
    assert 0.0 < abs(lagging[1][2, 1]) < 0.95 * abs(settled[1][2, 1])
    np.testing.assert_array_equal(settled[1], model.affine(first, around=np.array([1.0, 0.3]))[1])


def test_a_settled_memory_stays_settled() -> None:
    model, action = car(), np.array([1.0, 0.2])
    memory = model.initial_memory(action)
    after, retained = model.advance(STATES[0], action, memory)
    assert list(map(pytest.approx, memory)) == list(retained)
    np.testing.assert_array_equal(after, model.step(STATES[0], action))


class _OwnDrag(RateEffect):
    """A user's effect that calls abs() and compares: neither takes complex numbers."""

    name, robot, stage = "own_drag", "car", Stage.RESISTANCE
    equation = signature = source = "d(speed)/dt -= coefficient |speed| speed"
    parameters = (Parameter("coefficient", "1/m", 0.0, 2.0, 0.1),)

    def modify(self, rates: Any, parameters: Any, context: Context) -> Any:
        speed = context.state["speed"]
        drag = context.operations.where(speed > 0.0, parameters["coefficient"] * abs(speed) * speed, 0.0)
        return {**rates, "speed": rates["speed"] - drag}


def test_slopes_of_a_users_effect_are_right_too() -> None:
    state, around = np.array([0.0, 0.0, 0.2, 3.0]), np.array([3.5, 0.1])
    values = {"coefficient": Setting(0.5)}
    own = load_model("car").with_effect(_OwnDrag(), values).affine(state, around=around)
    shipped = load_model("car").with_effect(effect("car", "quadratic_drag"), values).affine(state, around=around)
    for one, other in zip(own, shipped, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-8)


def test_one_period_per_row_of_a_batch() -> None:
    values = {"base.wheelbase": Setting(0.3), "base.drive_gain": Setting(5.0)}
    model = PhysicsModel(KinematicBicycle("throttle"), (), values)
    model = model.with_effect(effect("car", "rolling_resistance"), {"deceleration": Setting(0.4)})
    periods = np.array([0.01, 0.05, 0.1])
    after, _ = model.advance(STATES, ACTIONS, (), period=periods)  # type: ignore[arg-type]
    for row, period in enumerate(periods):
        one, _ = model.advance(STATES[row], ACTIONS[row], (), period=float(period))
        np.testing.assert_allclose(after[row], one, atol=1e-12)


def test_an_overflow_gives_nan() -> None:
    model = pendulum(0.01)
    for state in (np.array([math.inf, 0.0]), np.array([math.nan, 0.0])):
        assert not np.isfinite(model.step(state, np.zeros(1))).any()
    f, g = model.affine(np.array([0.0, math.inf]))
    assert not np.isfinite(f).all()
    assert g.shape == (2, 1)


def test_unknown_parameter_of_an_added_effect_is_refused() -> None:
    with pytest.raises(ModelFileError, match=r"quadratic_drag.coeficient: unknown parameter"):
        load_model("car").with_effect(effect("car", "quadratic_drag"), {"coeficient": Setting(0.1)})


def test_effects_must_fit_robot_and_drive() -> None:
    with pytest.raises(ModelFileError, match="'tip_mass' belongs to robot 'pendulum'"):
        load_model("car").with_effect(effect("pendulum", "tip_mass"), {})
    with pytest.raises(ModelFileError, match="'back_emf' needs the action 'throttle'"):
        load_model("car").with_effect(effect("car", "back_emf"), {})
    values = {"base.wheelbase": Setting(0.3), "base.drive_gain": Setting(5.0)}
    throttle = PhysicsModel(KinematicBicycle("throttle"), (), values)
    assert throttle.with_effect(effect("car", "back_emf"), {}).effects[0].name == "back_emf"


def test_an_actuator_settles_at_what_the_ones_before_it_make_of_the_action() -> None:
    without_lag = load_model("car").with_effect(effect("car", "steering_gain"), {"gain": Setting(1.2)})
    chain = without_lag.with_effect(effect("car", "steering_lag"), {"time_constant": Setting(0.3)})
    state, action = np.array([0.0, 0.0, 0.0, 1.0]), np.array([1.0, 0.3])
    np.testing.assert_allclose(chain.step(state, action), without_lag.step(state, action), atol=1e-12)


WHEELBASE = 0.31


def tracked_car(tracked_point: float, free: bool = False) -> PhysicsModel:
    values = {"wheelbase": WHEELBASE, "speed_gain": 4.0, "acceleration_limit": 6.0}
    own = {f"base.{name}": Setting(value) for name, value in values.items()}
    own["base.tracked_point"] = Setting(tracked_point, free)
    return PhysicsModel(KinematicBicycle(), (), own, period=0.01)


def driven(model: PhysicsModel, state: np.ndarray, action: np.ndarray, steps: int) -> np.ndarray:
    for _ in range(steps):
        state = model.step(state, action)
    return state


@given(point=st.floats(-0.3, 0.5), steer=st.floats(-0.34, 0.34), yaw=st.floats(-3.0, 3.0), speed=st.floats(-0.6, 2.0))
def test_two_points_of_one_car_stay_a_rigid_distance_apart(point, steer, yaw, speed):
    # at a steady speed; the point ahead is as fast as the rear axle over cos(beta)
    beta = math.atan(point / WHEELBASE * math.tan(steer))
    heading = np.array([math.cos(yaw), math.sin(yaw), 0.0, 0.0])
    rear = np.array([0.4, -1.0, yaw, speed])
    ahead = rear + point * heading
    ahead[3] = speed / math.cos(beta)
    rear = driven(tracked_car(0.0), rear, np.array([speed, steer]), 100)
    ahead = driven(tracked_car(point), ahead, np.array([ahead[3], steer]), 100)
    expected = rear[:3] + point * np.array([math.cos(rear[2]), math.sin(rear[2]), 0.0])
    np.testing.assert_allclose(ahead[:3], expected, atol=1e-7)


@pytest.mark.parametrize("steer", [-0.3, 0.2])
def test_the_point_drives_the_circle_of_its_own_radius(steer: float) -> None:
    radius = math.hypot(WHEELBASE / math.tan(steer), 0.15)
    after = tracked_car(0.15).step(np.array([0.0, 0.0, 0.0, 1.2]), np.array([1.2, steer]))
    assert after[2] == pytest.approx(math.copysign(1.2 / radius, steer) * 0.01, rel=1e-9)


@pytest.mark.parametrize("kind", ["numpy", "torch"])
def test_a_free_point_is_part_of_the_latent(kind: str) -> None:
    torch = pytest.importorskip("torch")
    model = tracked_car(0.1, free=True)
    assert model.latent_names == ("base.tracked_point",)
    make = np.asarray if kind == "numpy" else torch.tensor
    states = [[0.0, 0.0, 0.3, 1.0], [0.0, 0.0, 0.3, 1.0]]
    after = np.asarray(model.step(make(states), make([[1.0, 0.2]] * 2), make([[0.0], [0.15]])))
    for row, point in zip(after, (0.0, 0.15), strict=True):
        expected = tracked_car(point).step(np.array(states[0]), np.array([1.0, 0.2]))
        np.testing.assert_allclose(row, expected, atol=1e-6 if kind == "torch" else 1e-14)


def test_files_without_a_tracked_point_keep_their_fingerprint() -> None:
    # recorded before the parameter existed; calibrated margins name them
    known = {"car": "bc80428c2b0e", "dart_car": "001a81ce4ba1", "dfki_pendulum": "895d112df80b"}
    assert {name: fingerprint(load_model(name)) for name in known} == known


def test_the_tracked_point_is_written_unless_it_has_no_effect() -> None:
    assert "tracked_point" not in write_model(tracked_car(0.0))
    for model in (tracked_car(0.15), tracked_car(0.0, free=True)):
        assert parse_model(write_model(model)).settings == model.settings
    assert parse_model(write_model(tracked_car(0.0))).settings["base.tracked_point"] == Setting(0.0)
    assert fingerprint(tracked_car(0.15)) != fingerprint(tracked_car(0.0))


ROBOTS = ("car", "dart_car", "differential_drive", "pendulum", "point")
AT_ONCE = [
    (robot, item)
    for robot in ROBOTS
    for item in library_for(load_model(robot))
    if isinstance(item, CommandEffect)
    and item.initial_memory(dict.fromkeys(load_model(robot).system.action_names, 0.0)) is None
]


def drawn(model: PhysicsModel, generator: np.random.Generator) -> tuple[list[float], list[float], list[float]]:
    """A state, an action within the bounds and a latent."""
    low, high = model.system.action_low, model.system.action_high
    state = generator.normal(size=len(model.system.state_names))
    latent = model.latent * (1.0 + 0.1 * generator.normal(size=len(model.latent)))
    return state.tolist(), (low + (high - low) * generator.random(len(low))).tolist(), latent.tolist()


def reference(model: PhysicsModel, state: list[float], action: list[float], latent: list[float]) -> list[Any]:
    """The same step by the reference implementation of a new model, for actuators settled at the action."""
    new = PhysicsModel(model.base, model.effects, model.settings, model.period)
    assert new.scalar_step(new.period) is None
    memory = new.initial_memory(np.array(action), np.array(latent))
    return new.advance(np.array(state), np.array(action), memory, np.array(latent))[0].tolist()


def test_every_robot_has_a_command_effect_without_memory() -> None:
    assert {robot for robot, _ in AT_ONCE} == set(ROBOTS)


@pytest.mark.parametrize(("robot", "item"), AT_ONCE, ids=[f"{robot}-{item.name}" for robot, item in AT_ONCE])
def test_a_recorded_step_includes_command_effects_without_memory(robot: str, item: CommandEffect) -> None:
    """A bent steering made each decision three times as slow: the step was no straight line any more."""
    own = {p.name: Setting(0.4 * p.low + 0.6 * p.high, free=True) for p in item.parameters}  # far from doing nothing
    model = load_model(robot).with_effect(item, own)
    model.record_scalar_step()
    step, tangent = model.scalar_step(model.period), model.scalar_tangent()
    assert step is not None
    assert tangent is not None
    generator = np.random.default_rng(7)
    for _ in range(50):
        state, action, latent = drawn(model, generator)
        wanted = reference(model, state, action, latent)
        assert step(state, action, latent, 0.0) == wanted
        arrays = np.array(state), np.array(action)
        after, memory = model.advance(*arrays, (), np.array(latent))
        assert (after.tolist(), memory) == (wanted, ())
        value, slopes = tangent(state, action, latent, 0.0)
        assert value == wanted
        moved = PhysicsModel(model.base, model.effects, model.settings, model.period)  # nothing recorded yet
        f, g = moved.affine(arrays[0], np.array(latent), around=arrays[1])
        np.testing.assert_allclose(slopes, g, rtol=1e-12, atol=1e-14)
        np.testing.assert_allclose(f + g @ arrays[1], wanted, rtol=1e-12, atol=1e-12)


def test_nothing_is_pending_and_an_action_acts_at_once() -> None:
    model = load_model("car").with_effect(effect("car", "steering_offset"), {"angle": Setting(0.1)})
    assert model.initial_memory(np.array([1.0, 0.2])) == ()
    prediction = Prediction.of_model(model)
    assert not prediction.has_actuator_memory
    assert prediction.effect_start((0.0,) * 4, None, ()) is None
    assert model.felt([1.0, 0.2], (), period=0.05) == ([1.0, 0.2 + 0.1], ())


def test_command_effects_with_and_without_memory_are_applied_in_their_order() -> None:
    """The lag comes before the offset: what is felt is the mean of the way to the command, and the offset on top."""
    late = load_model("car").with_effect(effect("car", "steering_lag"), {"time_constant": Setting(0.1)})
    both = late.with_effect(effect("car", "steering_offset"), {"angle": Setting(0.1)})
    rest = np.array([1.0, 0.0])
    assert both.scalar_step(both.period) is None
    (alone,) = late.initial_memory(rest)
    assert both.initial_memory(rest) in ((alone, None), (None, {"steer": alone["steer"] + 0.1}))
    felt, cached = both.felt([1.0, 0.2], both.initial_memory(rest), period=0.05)
    expected, _ = late.felt([1.0, 0.2], late.initial_memory(rest), period=0.05)
    assert (felt[1], len(cached)) == (pytest.approx(expected[1] + 0.1), 2)


class Twice(CommandEffect):
    """A user's own, which no recording sees: felt steer = 2 steer."""

    name, robot, stage = "twice", "car", Stage.COMMAND_SCALE
    equation = signature = source = "steer_felt = 2 steer"
    parameters = (Parameter("factor", "1", 0.0, 3.0, 2.0),)

    def transform(self, action, memory, parameters, period, operations):
        del period, operations
        assert memory is None
        return {**action, "steer": action["steer"] * parameters["factor"]}, memory


def test_a_users_command_effect_without_memory_is_applied_without_a_recording() -> None:
    plain = load_model("car")
    model = plain.with_effect(Twice(), {"factor": Setting(2.0)})
    model.record_scalar_step()
    assert model.scalar_step(model.period) is None
    assert model.initial_memory(np.array([1.0, 0.1])) == ()
    state = np.array([0.1, -0.2, 0.3, 0.8])
    after, memory = model.advance(state, np.array([1.0, 0.1]), ())
    assert after.tolist() == plain.advance(state, np.array([1.0, 0.2]), ())[0].tolist()
    assert memory == ()
