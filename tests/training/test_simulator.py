"""The batched simulator computes the equations of the physics model; configurations, also with diagnosed models."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as some

from safedpa.dynamics import load_model, parse_model
from safedpa.errors import InputError
from safedpa.networks import load_weights
from safedpa_services.command_line.group import safedpa
from safedpa_sim.training.configuration import (
    Configuration,
    configurations,
    load_configuration,
    parse_configuration,
    with_diagnosed,
)
from safedpa_sim.training.data.transitions import draw_transitions, scales
from safedpa_sim.training.environments.batched_simulator import BatchedSimulator

CARS = BatchedSimulator(load_configuration("car"))


def changed(old: str, new: str) -> Configuration:
    path = configurations()["car"]
    text = path.read_text(encoding="utf-8")
    assert old in text
    return parse_configuration(text.replace(old, new, 1), path.parent)


def test_a_car_in_a_batch_moves_as_a_single_one() -> None:
    generator = CARS.generator(3)
    states, actions = CARS.draw_states(50, generator), CARS.draw_actions(50, generator)
    environments = CARS.draw_environments(50, generator)
    after, _ = CARS.advance(states, actions, environments)
    assert after.dtype == torch.float32
    for index in range(50):
        one = (item[index].numpy().astype(float) for item in (states, actions, environments))
        np.testing.assert_allclose(after[index].numpy(), CARS.model.step(*one), atol=2e-6)


def test_in_the_neutral_environment_it_is_the_plain_car() -> None:
    generator = CARS.generator(4)
    states, actions = CARS.draw_states(200, generator), CARS.draw_actions(200, generator)
    plain = load_configuration("car").simulator
    expected = plain.step(states.double().numpy(), actions.double().numpy())
    after, _ = CARS.advance(states, actions, CARS.nominal.expand(200, -1))
    np.testing.assert_allclose(after.numpy(), expected, atol=2e-6)


def test_what_is_drawn_lies_in_its_range_and_fills_it() -> None:
    generator = CARS.generator(0)
    for drawn, ranges in (
        (CARS.draw_states(20_000, generator), CARS.state_ranges),
        (CARS.draw_actions(20_000, generator), CARS.action_ranges),
        (CARS.draw_environments(20_000, generator), CARS.environment_ranges),
    ):
        low, high = ranges.unbind(1)
        assert bool((drawn >= low).all())
        assert bool((drawn <= high).all())
        assert bool((drawn.amax(0) - drawn.amin(0) >= 0.99 * (high - low)).all())


def test_an_effect_is_absent_as_a_whole_in_its_share_of_the_environments() -> None:
    drawn = dict(
        zip([entry.path for entry in CARS.entries], CARS.draw_environments(20_000, CARS.generator(1)).T, strict=True)
    )
    no_force = drawn["constant_force.ax"] == 0.0
    assert torch.equal(no_force, drawn["constant_force.ay"] == 0.0)
    no_load = drawn["towed_load.mass_ratio"] == 0.0
    assert float(no_force.float().mean()) == pytest.approx(0.2, abs=0.015)
    assert float(no_load.float().mean()) == pytest.approx(0.2, abs=0.015)
    assert float((no_force & no_load).float().mean()) == pytest.approx(0.04, abs=0.01)
    # a parameter that only shapes the load is drawn even if there is no load
    assert len(drawn["towed_load.deceleration"][no_load].unique()) > 1000


def test_the_same_seed_draws_the_same() -> None:
    first, again = (draw_transitions(CARS, 100, CARS.generator(7)) for _ in range(2))
    for one, other in zip(first, again, strict=True):
        assert torch.equal(one, other)
    assert not torch.equal(first.state, draw_transitions(CARS, 100, CARS.generator(8)).state)


def test_the_increment_is_in_the_cars_own_frame() -> None:
    drawn = draw_transitions(CARS, 2000, CARS.generator(2))
    turned = drawn.state.clone()
    turned[:, 2] += 1.0
    turned[:, :2] += 5.0
    # without a force of fixed direction, the motion does not depend on position and heading
    environment = drawn.environment * torch.tensor([0.0 if "force" in e.path else 1.0 for e in CARS.entries])
    generator = CARS.generator(9)
    here = draw_transitions(CARS, 2000, generator, environment=environment, state=drawn.state)
    there, _ = CARS.advance(turned, here.action, environment)
    from safedpa.networks import frame_of

    np.testing.assert_allclose(frame_of("car").own_increment(turned, there), here.increment, atol=5e-6)


def test_scales_make_numbers_of_size_one() -> None:
    vectors = scales(CARS, 0)
    assert vectors["feature_middle"].tolist() == pytest.approx([0.0, 0.0, 0.75], abs=1e-6)
    assert vectors["feature_scale"].tolist() == pytest.approx([1.0, 1.0, 1.55], abs=1e-6)
    assert vectors["action_middle"].tolist() == pytest.approx([0.7, 0.0], abs=1e-6)
    assert vectors["action_scale"].tolist() == pytest.approx([1.3, 0.34], abs=1e-6)
    scaled = draw_transitions(CARS, 50_000, CARS.generator(11)).increment / vectors["increment_scale"]
    assert scaled.std(0).tolist() == pytest.approx([1.0] * 4, abs=0.02)


def test_any_effect_of_the_library_can_be_randomised_including_one_with_memory() -> None:
    lag = "[environment.steering_lag]\ntime_constant = [0.05, 0.2]\n[environment.towed_load]"
    cars = BatchedSimulator(changed("[environment.towed_load]", lag))
    assert "steering_lag.time_constant" in [entry.path for entry in cars.entries]
    assert cars.remembers
    assert not CARS.remembers
    generator = cars.generator(0)
    environments = cars.draw_environments(1000, generator)
    straight, left = torch.tensor([[1.0, 0.0]] * 1000), torch.tensor([[1.0, 0.3]] * 1000)
    start = torch.tensor([[0.0, 0.0, 0.0, 1.0]] * 1000)
    fresh, memory = cars.advance(start, left, environments, cars.settled(straight, environments))
    settled, _ = cars.advance(start, left, environments, cars.settled(left, environments))
    later, _ = cars.advance(start, left, environments, memory)
    lagging = environments[:, [entry.path for entry in cars.entries].index("steering_lag.time_constant")] > 0.0
    assert bool((fresh[lagging, 2] < later[lagging, 2]).all())
    assert bool((later[lagging, 2] < settled[lagging, 2]).all())


def test_a_parameter_of_the_base_can_be_randomised() -> None:
    cars = BatchedSimulator(
        changed("[environment.towed_load]", "[environment.base]\nspeed_gain = [3.0, 6.0]\n[environment.towed_load]")
    )
    assert (cars.entries[0].path, float(cars.nominal[0])) == ("base.speed_gain", 4.0)
    assert float(cars.draw_environments(1000, cars.generator(0))[:, 0].std()) > 0.5


def test_a_simulator_file_is_found_next_to_its_configuration(tmp_path: Path) -> None:
    folder = configurations()["car"].parent
    for name in ("car.toml", "published_car.toml"):
        (tmp_path / name).write_text((folder / name).read_text(encoding="utf-8"), encoding="utf-8")
    assert load_configuration(tmp_path / "car.toml").digest("phase_1a") == load_configuration("car").digest("phase_1a")


PATH = configurations()["car"]
TEXT = PATH.read_text(encoding="utf-8")


FORCE, WIND = {"constant_force.ax", "constant_force.ay"}, {"wind.speed", "wind.upward"}
LOADED = {*FORCE, "towed_load.mass_ratio", "towed_load.deceleration"}
RANDOMISED = {
    **dict.fromkeys(("car", "car_small"), LOADED),
    **dict.fromkeys(("car_paper", "car_paper_small", "point", "point_small"), FORCE),
    **dict.fromkeys(("pendulum", "pendulum_small"), WIND),
}


@pytest.mark.parametrize("name", sorted(configurations()))
def test_every_configuration_that_ships_can_be_read_by_its_name(name: str) -> None:
    table = load_configuration(name).as_table()
    randomised = table["environment"]
    assert all(low < high for low, high in randomised.values())
    assert randomised.keys() == RANDOMISED[name]
    if "towed_load.mass_ratio" in randomised:
        assert randomised["towed_load.mass_ratio"][0] == 0.0
    assert load_configuration(f"{name}.toml").as_table() == table


MISTAKES = [
    ("seed = 0", "sed = 0", "sed: unknown key; did you mean 'seed'?"),
    ("seed = 0", "seed = -1", "seed: got -1, wanted 0 to inf"),
    ("seed = 0", "seed = 0.5", "seed: got 0.5, wanted a value of type int"),
    ("seed = 0", "seed = true", "seed: got True, wanted a value of type int"),
    ("history = 52", "history = 20", "history: got 20, wanted 36 to 1000"),
    ("absent = 0.2", "absent = 1.2", "absent: got 1.2, wanted 0 to 1"),
    ('"published_car.toml"', "3", "simulator: got 3, wanted the path of a model file"),
    ("speed = [-0.8, 2.3]", "sped = [-0.8, 2.3]", "state.sped: unknown key; did you mean 'speed'?"),
    ("speed = [-0.8, 2.3]", "speed = [2.3, -0.8]", "state.speed: got [2.3, -0.8], wanted [low, high] with low < high"),
    ("speed = [-0.8, 2.3]", "speed = 2.3", "state.speed: got 2.3, wanted [low, high]"),
    ("speed = [-0.8, 2.3]", "speed = [nan, 2.3]", "state.speed: got nan, wanted a finite number"),
    ("steer = [-0.34, 0.34]", "", "action.steer: missing; give its range as [low, high]"),
    ("[environment.towed_load]", "[environment.towed_lod]", "environment.towed_lod: effect 'towed_lod' is not known"),
    ("mass_ratio =", "mass_ration =", "environment.towed_load.mass_ration: unknown key; did you mean 'mass_ratio'?"),
    ("[0.0, 1.6]", "[0.0, 16.0]", "environment.towed_load.mass_ratio: got 0 to 16, wanted within 0 to 5 (no unit)"),
    ("[phase_1a]", "[phase_1]", "phase_1: unknown key; did you mean"),
    ("pairs = 20_000_000", 'pairs = "many"', "phase_1a.pairs: got 'many', wanted a value of type int"),
    ("pairs = 20_000_000", "pairs = 0", "phase_1a.pairs: got 0, wanted 1 to inf"),
    ("pairs = 20_000_000", "pair = 1", "phase_1a.pair: unknown key; did you mean 'pairs'?"),
    ("[phase_1a]", "[phase_1a", "not TOML: "),
]


@pytest.mark.parametrize(("good", "bad", "message"), MISTAKES, ids=[mistake[2][:40] for mistake in MISTAKES])
def test_a_mistake_gets_one_line_that_names_the_key(good: str, bad: str, message: str) -> None:
    assert good in TEXT
    with pytest.raises(InputError) as caught:
        parse_configuration(TEXT.replace(good, bad, 1), PATH.parent)
    assert str(caught.value).startswith(message)
    assert "\n" not in str(caught.value)


def test_a_missing_file_lists_the_shipped_configurations() -> None:
    with pytest.raises(InputError, match=r"boat: cannot be read .* or one of car, car_paper"):
        load_configuration("boat")


def test_an_integer_is_accepted_for_a_decimal() -> None:
    assert parse_configuration(TEXT.replace("absent = 0.2", "absent = 0"), PATH.parent).absent == 0.0


def test_the_digest_depends_on_what_decides_a_phase_and_nothing_else() -> None:
    car = load_configuration("car")
    more = replace(car, ablations=replace(car.ablations, pairs=7))
    assert more.digest("phase_1a") == car.digest("phase_1a")
    assert more.digest("phase_1a", "ablations") != car.digest("phase_1a", "ablations")
    assert replace(car, seed=1).digest("phase_1a") != car.digest("phase_1a")
    longer = replace(car, history=68)
    assert longer.digest("phase_1a", "phase_1b") == car.digest("phase_1a", "phase_1b")
    assert longer.digest("phase_1a", "phase_2") != car.digest("phase_1a", "phase_2")
    other = parse_configuration(TEXT.replace("[0.0, 1.6]", "[0.0, 1.5]"), PATH.parent)
    assert other.digest() != car.digest()


torch_fast_simulator = pytest.importorskip("torch")


@given(some.sampled_from(("car", "pendulum")), some.integers(0, 2**31 - 1), some.sampled_from((1, 7, 500, 8193)))
@settings(max_examples=20)
def test_arrays_and_tensors_agree(name, seed, count):
    """Agrees in float32 to 1e-6 of each entry's size, also across the border between two chunks."""
    robots = BatchedSimulator(load_configuration(name))
    assert robots.model.batch_step(robots.model.period) is not None, "the fast way is what is tested"
    draw = robots.generator(seed)
    environment, state = robots.draw_environments(count, draw), robots.draw_states(count, draw)
    action = robots.draw_actions(count, draw)
    ours = robots.advance(state, action, environment, robots.settled(action, environment))[0]
    memory = robots.model.initial_memory(action, environment)
    reference = robots.model.advance(state.double(), action.double(), memory, environment.double())[0].numpy()
    assert ours.dtype == torch_fast_simulator.float32
    assert (np.abs(ours.numpy() - reference) / np.maximum(np.abs(reference), 1.0)).max() < 2e-6


def test_gradients_are_computed_on_tensors():
    robots = BatchedSimulator(load_configuration("car"))
    draw = robots.generator(1)
    environment, state = robots.draw_environments(5, draw), robots.draw_states(5, draw)
    action = robots.draw_actions(5, draw).requires_grad_()
    robots.advance(state, action, environment)[0].sum().backward()
    assert action.grad is not None
    assert torch_fast_simulator.isfinite(action.grad).all()


def test_actuators_with_memory_have_no_recorded_step():
    from safedpa.effects.library import effect

    lagged = load_model("car").with_effect(effect("car", "steering_lag"), {})
    assert lagged.batch_step(lagged.period) is None
    assert load_model("car_learned").batch_step(0.05) is None


FOUND = """format = 1
robot = "car"
period = 0.02
[base]
kind = "kinematic_bicycle"
drive = "speed_servo"
wheelbase = 0.32
speed_gain = { value = 3.1, free = true }
acceleration_limit = 6.0
[[effects]]
name = "quadratic_drag"
coefficient = 0.12
[[effects]]
name = "speed_command_gain"
gain = 0.8
[[effects]]
name = "towed_load"
mass_ratio = 0.5
deceleration = 1.0
"""


@pytest.fixture(scope="module")
def configuration():
    return with_diagnosed(load_configuration("car_small"), parse_model(FOUND))


def test_effects_are_drawn_around_the_diagnosed_value(configuration):
    assert configuration.environment["quadratic_drag.coefficient"] == pytest.approx((0.06, 0.18))
    assert configuration.environment["speed_command_gain.gain"] == pytest.approx((0.7, 0.9))
    given = load_configuration("car_small").environment
    assert configuration.environment["towed_load.mass_ratio"] == given["towed_load.mass_ratio"]
    assert set(given) < set(configuration.environment)


def test_the_simulator_is_the_diagnosed_model_at_the_period_of_the_configuration(configuration):
    assert configuration.simulator.period == load_configuration("car_small").simulator.period
    cars = BatchedSimulator(configuration)
    values = {path: setting.value for path, setting in cars.model.settings.items()}
    assert (values["base.speed_gain"], values["base.wheelbase"]) == (3.1, 0.32)
    names = [entry.path for entry in cars.entries]
    drawn = cars.draw_environments(2000, cars.generator(1))[:, names.index("quadratic_drag.coefficient")]
    acting = drawn[drawn > 0.0]
    assert 0.15 < (drawn == 0.0).float().mean() < 0.25
    assert 0.06 <= acting.min() < 0.07
    assert 0.17 < acting.max() <= 0.18


def test_the_command_trains_weights_that_know_the_effect(tmp_path, capsys):
    torch.set_num_threads(1)
    path = tmp_path / "model.toml"
    path.write_text(FOUND, encoding="utf-8")
    out = str(tmp_path / "learned")
    few = ["train", "car", "--small", "--pairs", "4096", "--phases", "1a"]
    assert safedpa.run([*few, "--model", str(path), "--out", out, "--json"]) == 0
    capsys.readouterr()
    entries = load_weights(tmp_path / "learned" / "car_simulated.safetensors").description.environment
    assert "quadratic_drag.coefficient" in {entry.path for entry in entries}


@pytest.mark.parametrize(("name", "message"), [("car_learned", "wanted physics"), ("dart_car", "throttle")])
def test_models_that_cannot_be_trained_on_are_refused(name, message):
    with pytest.raises(InputError, match=message):
        with_diagnosed(load_configuration("car_small"), load_model(name))
