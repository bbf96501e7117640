"""The batched simulator is the model that people read: same equations, many robots, single precision."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from safedpa_sim.training.configuration import Configuration, configurations, load_configuration, parse_configuration
from safedpa_sim.training.simulator import BatchedCars
from safedpa_sim.training.transitions import draw_transitions, scales

CARS = BatchedCars(load_configuration("car"))


def changed(old: str, new: str) -> Configuration:
    path = configurations()["car"]
    text = path.read_text(encoding="utf-8")
    assert old in text
    return parse_configuration(text.replace(old, new, 1), path.parent)


def test_every_car_moves_as_the_same_car_alone() -> None:
    generator = CARS.generator(3)
    states, actions = CARS.draw_states(50, generator), CARS.draw_actions(50, generator)
    environments = CARS.draw_environments(50, generator)
    after, _ = CARS.advance(states, actions, environments)
    assert after.dtype == torch.float32
    for index in range(50):
        one = (item[index].numpy().astype(float) for item in (states, actions, environments))
        np.testing.assert_allclose(after[index].numpy(), CARS.model.step(*one), atol=2e-6)


def test_where_nothing_acts_it_is_the_plain_car() -> None:
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
    # what only shapes the load says nothing about whether there is one: it is drawn all the same
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
    # without a force that has a direction in the world, all of it looks the same from another place and heading
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


def test_any_effect_of_the_library_can_be_named_and_one_that_remembers_does() -> None:
    cars = BatchedCars(
        changed(
            "[environment.towed_load]",
            "[environment.steering_lag]\ntime_constant = [0.05, 0.2]\n[environment.towed_load]",
        )
    )
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
    cars = BatchedCars(
        changed("[environment.towed_load]", "[environment.base]\nspeed_gain = [3.0, 6.0]\n[environment.towed_load]")
    )
    assert cars.entries[0].path == "base.speed_gain"
    assert float(cars.nominal[0]) == 4.0
    assert float(cars.draw_environments(1000, cars.generator(0))[:, 0].std()) > 0.5


def test_a_simulator_file_is_found_next_to_its_configuration(tmp_path: Path) -> None:
    folder = configurations()["car"].parent
    for name in ("car.toml", "published_car.toml"):
        (tmp_path / name).write_text((folder / name).read_text(encoding="utf-8"), encoding="utf-8")
    assert load_configuration(tmp_path / "car.toml").digest("phase_1a") == load_configuration("car").digest("phase_1a")
