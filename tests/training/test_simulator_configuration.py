"""Configurations of a training: what is wrong is named by its key."""

from __future__ import annotations

from dataclasses import replace

import pytest

from safedpa.errors import InputError
from safedpa_sim.training.configuration import configurations, load_configuration, parse_configuration

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


def test_a_file_that_is_not_there_names_those_that_ship() -> None:
    with pytest.raises(InputError, match=r"boat: cannot be read .* or one of car, car_paper"):
        load_configuration("boat")


def test_a_whole_number_serves_as_a_decimal() -> None:
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
