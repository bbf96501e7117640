"""Model files, what is written and read back and every mistake in one line, and models that are learned."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safedpa.dynamics import (
    LearnedBase,
    PhysicsModel,
    Setting,
    fingerprint,
    load_model,
    parse_model,
    save_model,
    shipped_models,
    write_model,
)
from safedpa.effects import effects_of
from safedpa.effects.library import effect
from safedpa.effects.parameter import Parameter
from safedpa.errors import ModelFileError
from safedpa.networks import Weights, save_weights
from safedpa.robots.car.dynamics.kinematic_bicycle import KinematicBicycle
from safedpa.robots.pendulum.rigid_pendulum import RigidPendulum

CAR = """
format = 1
robot = "car"
period = 0.05
[base]
kind = "kinematic_bicycle"
drive = "speed_servo"
wheelbase = 0.32
speed_gain = 3.0
acceleration_limit = 6.0
[[effects]]
name = "towed_load"
mass_ratio = { value = 0.4, free = true, unit = "1" }
deceleration = 2.0
"""

PENDULUM = """
format = 1
robot = "pendulum"
[base]
kind = "rigid_pendulum"
length = 0.5
mass = 1.0
"""


def settings_of(owner: str, parameters: tuple[Parameter, ...]) -> st.SearchStrategy[dict[str, Setting]]:
    each = {p.name: st.builds(Setting, st.floats(p.low, p.high), st.booleans()) for p in parameters}
    return st.fixed_dictionaries({f"{owner}.{name}": own for name, own in each.items()})


@st.composite
def models(draw: st.DrawFn) -> PhysicsModel:
    base = draw(st.sampled_from([KinematicBicycle(), KinematicBicycle("throttle"), RigidPendulum()]))
    known = [e for e in effects_of(base.system.name).values() if set(e.needs) <= set(base.system.action_names)]
    effects = draw(st.lists(st.sampled_from(known), unique_by=lambda item: item.name, max_size=5))
    values = draw(settings_of("base", base.parameters))
    for item in effects:
        values |= draw(settings_of(item.name, item.parameters))
    return PhysicsModel(base, effects, values, draw(st.floats(1e-4, 1.0)))


@settings(max_examples=60, deadline=None)
@given(model=models())
def test_what_is_written_is_read_back(model: PhysicsModel) -> None:
    text = write_model(model)
    again = parse_model(text)
    assert (again.settings, again.period) == (model.settings, model.period)
    assert again.latent_names == model.latent_names
    assert [item.name for item in again.effects] == [item.name for item in model.effects]
    assert type(again.base) is type(model.base)
    assert (again.system, write_model(again)) == (model.system, text)


def test_file_from_a_fit_holds_plain_numbers(tmp_path: Path) -> None:
    model = parse_model(CAR).with_settings({"towed_load.deceleration": Setting(np.float64(1.25))})
    save_model(model, tmp_path / "model.toml")
    assert "deceleration = 1.25  # m/s2" in (tmp_path / "model.toml").read_text()
    assert load_model(tmp_path / "model.toml").settings == model.settings


def test_defaults_are_gravity_and_the_period() -> None:
    model = parse_model(PENDULUM)
    assert model.settings["base.gravity"] == Setting(9.81)
    assert model.period == 0.05


@pytest.mark.parametrize("name", sorted(shipped_models()))
def test_every_shipped_model_loads_by_its_name(name: str) -> None:
    for source in (name, f"{name}.toml"):
        model = load_model(source)
        assert parse_model(write_model(model), shipped_models()[name].parent).settings == model.settings


MISTAKES = [
    ("format = 1", "format = 2", "format: got 2, wanted 1; this program reads no other"),
    ("format = 1", "", "format: missing, wanted 1; this program reads no other"),
    ('robot = "car"', 'robot = "boat"', "robot: got 'boat', wanted one of car, differential_drive, pendulum, point"),
    ("period = 0.05", "periode = 0.05", "periode: unknown key; did you mean 'period'?"),
    ("period = 0.05", "period = 0", "period: got 0, wanted 0.0001 to 3600 s"),
    ("period = 0.05", 'period = "20 Hz"', "period: got '20 Hz', wanted a finite number in s"),
    ("[base]", "[bse]", "bse: unknown key; did you mean 'base'?"),
    ("kinematic_bicycle", "dynamic_bicycle", "base.kind: got 'dynamic_bicycle', wanted 'kinematic_bicycle'"),
    ("speed_servo", "servo", "base.drive: got 'servo', wanted 'speed_servo' or 'throttle'"),
    ("wheelbase = 0.32", "", "base.wheelbase: missing; give a number, 0.01 to 10 m"),
    ("wheelbase = 0.32", "wheel_base = 0.32", "base.wheel_base: unknown key; did you mean 'wheelbase'?"),
    ("wheelbase = 0.32", 'wheelbase = "0.32 m"', "base.wheelbase: got '0.32 m', wanted a finite number in m"),
    ("wheelbase = 0.32", "wheelbase = nan", "base.wheelbase: got nan, wanted a finite number in m"),
    ("wheelbase = 0.32", "wheelbase = inf", "base.wheelbase: got inf, wanted a finite number in m"),
    ("wheelbase = 0.32", "wheelbase = true", "base.wheelbase: got True, wanted a finite number in m"),
    ("wheelbase = 0.32", "wheelbase = -0.3", "base.wheelbase: got -0.3, wanted 0.01 to 10 m"),
    ("speed_gain = 3.0", "drive_gain = 3.0", "base.drive_gain: unknown key"),
    ('unit = "1"', 'unit = "kg"', "towed_load.mass_ratio.unit: got 'kg', wanted '1'; convert the value"),
    ("value = 0.4, ", "", "towed_load.mass_ratio.value: missing; give a number, 0 to 5 (no unit)"),
    ("value = 0.4", "value = 7", "towed_load.mass_ratio: got 7, wanted 0 to 5 (no unit)"),
    ("free = true", 'free = "yes"', "towed_load.mass_ratio.free: got 'yes', wanted true or false"),
    ("free = true", "fre = true", "towed_load.mass_ratio.fre: unknown key; did you mean 'free'?"),
    ("deceleration = 2.0", "", "towed_load.deceleration: missing; give a number, 0 to 9.81 m/s2"),
    ("deceleration = 2.0", "deceleration = 20", "towed_load.deceleration: got 20, wanted 0 to 9.81 m/s2"),
    ("deceleration = 2.0", "decelaration = 2.0", "towed_load.decelaration: unknown key; did you mean 'deceleration'?"),
    ('"towed_load"', '"towed_lod"', "effects.name: effect 'towed_lod' is not known for robot 'car': did you mean 'tow"),
    ('"towed_load"', '"tip_mass"', "effects.name: effect 'tip_mass' belongs to robot 'pendulum', not to 'car'"),
    ('name = "towed_load"', "", "effects.name: missing, wanted the name of an effect; 'safedpa effects' lists them"),
    ('name = "towed_load"', "name = 3", "effects.name: got 3, wanted the name of an effect"),
    ("[[effects]]", "[effects]", "effects: wanted one table [[effects]] per effect, with the key 'name'"),
    ("[base]", "[base", "not TOML: "),
]


@pytest.mark.parametrize(("good", "bad", "message"), MISTAKES, ids=[f"{i}:{m[2][:40]}" for i, m in enumerate(MISTAKES)])
def test_mistake_gets_one_line_that_names_the_key(good: str, bad: str, message: str, tmp_path: Path) -> None:
    assert good in CAR
    path = tmp_path / "mine.toml"
    path.write_text(CAR.replace(good, bad, 1))
    with pytest.raises(ModelFileError) as caught:
        load_model(path)
    text = str(caught.value)
    assert text.startswith(f"{path}: {message}")
    assert "\n" not in text


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (CAR + CAR[CAR.index("[[effects]]") :], "effect 'towed_load' is listed twice; leave one out"),
        (CAR + '[[effects]]\nname = "back_emf"\ncoefficient = 1.0\n',
         "effect 'back_emf' needs the action 'throttle', the model has target_speed"),
        (PENDULUM + 'drive = "throttle"\n', r"base.drive: unknown key"),
        ('format = 1\nrobot = "car"\n', r"base: missing; wanted a table \[base\] with the key 'kind'"),
    ],
)  # fmt: skip
def test_a_file_with_too_much_or_too_little_is_refused(text: str, message: str) -> None:
    with pytest.raises(ModelFileError, match=message):
        parse_model(text)


def test_missing_file_names_the_shipped_ones(tmp_path: Path) -> None:
    with pytest.raises(ModelFileError, match=r"none.toml: cannot be read .* or one of .*car"):
        load_model(tmp_path / "none.toml")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ModelFileError, match="cannot be read"):
        load_model(tmp_path / "binary.toml")


def test_a_folder_of_the_same_name_hides_no_model_that_ships(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "pendulum").mkdir()
    monkeypatch.chdir(tmp_path)
    assert load_model("pendulum").system.name == "pendulum"


STATE = np.array([1.0, -2.0, 0.7, 1.1])
ACTION = np.array([1.5, 0.2])
LATENT = np.array([0.3, -0.2, 0.1, 0.5])


@pytest.fixture
def model(random_car_weights) -> PhysicsModel:
    return learned(random_car_weights(1))


def learned(weights: Weights) -> PhysicsModel:
    nominal = load_model("car")
    settings = {path: setting for path, setting in nominal.settings.items() if path.startswith("base.")}
    return PhysicsModel(LearnedBase(nominal.base, weights), (), settings)


def test_a_learned_model_steps_as_its_networks_predict(model):
    f, g = model.base.networks.increment(STATE, LATENT)
    np.testing.assert_allclose(model.step(STATE, ACTION, LATENT), STATE + f + g @ ACTION, atol=1e-12)
    tangent = model.affine(STATE, LATENT)
    np.testing.assert_allclose(tangent[0], STATE + f, atol=1e-12)
    np.testing.assert_allclose(tangent[1], g, atol=1e-12)


def test_one_many_and_torch_agree(model):
    torch = pytest.importorskip("torch")
    draw = np.random.default_rng(0)
    states, actions, latents = (draw.normal(size=(7, size)) for size in (4, 2, 4))
    many = model.step(states, actions, latents)
    tensors = model.step(*(torch.from_numpy(part) for part in (states, actions, latents)))
    np.testing.assert_allclose(tensors.numpy(), many, atol=1e-6)
    for row in range(7):
        np.testing.assert_allclose(model.step(states[row], actions[row], latents[row]), many[row], atol=1e-6)
    f, g = model.affine(states, latents, around=actions)
    np.testing.assert_allclose(f + np.einsum("nsa,na->ns", g, actions), many, atol=1e-6)


def test_the_latent_is_free_and_starts_where_nothing_acts(model):
    assert model.latent_names == tuple(f"base.latent_{index}" for index in range(4))
    np.testing.assert_array_equal(model.latent, np.zeros(4))


def test_effects_are_added_to_the_networks(model):
    wind = effect("car", "constant_force")
    windy = model.with_effect(wind, {"ax": Setting(0.8), "ay": Setting(0.0)})
    change = windy.step(STATE, ACTION, LATENT) - model.step(STATE, ACTION, LATENT)
    np.testing.assert_allclose(change, [0.0, 0.0, 0.0, 0.05 * 0.8 * np.cos(STATE[2])], atol=1e-9)


def test_a_file_with_weights_round_trips_and_other_weights_are_another_model(model, random_car_weights, tmp_path):
    windy = model.with_effect(effect("car", "constant_force"), {"ax": Setting(0.8), "ay": Setting(0.0)})
    save_model(windy, tmp_path / "learned.toml")
    again = load_model(tmp_path / "learned.toml")
    assert again.latent_names == windy.latent_names
    assert fingerprint(again) == fingerprint(windy) != fingerprint(model)
    assert fingerprint(learned(random_car_weights(2))) != fingerprint(model)
    np.testing.assert_array_equal(again.step(STATE, ACTION, LATENT), windy.step(STATE, ACTION, LATENT))


def test_weights_that_do_not_fit_are_refused(model, random_car_weights, tmp_path):
    path = tmp_path / "learned.toml"
    save_model(model, path)
    text = path.read_text()
    save_weights(random_car_weights(2), tmp_path / "learned.safetensors")
    with pytest.raises(ModelFileError, match=r"networks\.digest: got"):
        load_model(path)
    path.write_text(text.replace("learned.safetensors", "absent.safetensors"))
    with pytest.raises(ModelFileError, match=r"networks\.weights: .*absent"):
        load_model(path)
    weights = random_car_weights(2)
    slow = Weights(weights.tensors, replace(weights.description, period=0.1))
    save_weights(slow, tmp_path / "slow.safetensors")
    other = text.replace("learned.safetensors", "slow.safetensors")
    path.write_text(other.replace(model.base.weights.digest, slow.digest))
    with pytest.raises(ModelFileError, match=r"period: got 0.05 s, the networks were trained for 0.1 s"):
        load_model(path)
    path.write_text(text.replace("weights = ", "weigths = "))
    with pytest.raises(ModelFileError, match=r"networks\.weights: missing"):
        load_model(path)


def test_weights_of_another_robot_are_refused(random_car_weights):
    with pytest.raises(ModelFileError, match=r"trained for robot 'car'.*the model is a 'pendulum'"):
        LearnedBase(load_model("dfki_pendulum").base, random_car_weights(0))
