"""Settings of the filter: defaults, files, and what is refused with the name of its key."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from safedpa.errors import InputError
from safedpa.robots.car.barriers.obstacles import braking_of
from safedpa.safety import FilterSettings, load_settings, parse_settings, save_settings, write_settings


def test_the_bounds_are_the_robots_and_the_defaults_what_the_page_says() -> None:
    settings = FilterSettings.for_robot("car")
    np.testing.assert_array_equal(settings.low, [-0.6, -0.34])
    np.testing.assert_array_equal(settings.high, [2.0, 0.34])
    np.testing.assert_array_equal(settings.weight_vector, [1.0, 1.0])
    np.testing.assert_array_equal(settings.resting_action, [0.0, 0.0])
    assert (braking_of(settings).deceleration, braking_of(settings).gain) == (2.0, 2.5)
    left = FilterSettings.for_robot("car")
    assert (left.eta, left.relinearisations, left.plausible_nominal) == (0.2, 3, 10.0)
    names = ("braking_deceleration", "braking_gain", "speed_low", "speed_high", "clearance", "own_radius", "creeping")
    assert left.barriers == dict(zip(names, (2.0, 2.5, -0.8, 2.2, 0.05, 0.0, 0.0), strict=True))
    pendulum = FilterSettings.for_robot("pendulum")
    assert parse_settings('system = "pendulum"') == pendulum
    assert pendulum.barriers == {"corridor_seconds": 0.25}


def test_what_differs_from_the_defaults_is_shown() -> None:
    settings = replace(FilterSettings.for_robot("car"), eta=0.3)
    assert repr(settings) == "FilterSettings(system=car, action_low=(-0.6, -0.34), action_high=(2.0, 0.34), eta=0.3)"


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"enabled": False, "epsilon": 0.02, "weights": (1.0, 4.0), "backup_action": (0.0, 0.1)},
        {"system": "", "action_low": (-1.0,), "action_high": (2.5,), "epsilon": {"own kind": 0.1, "default": 0.0}},
    ],
    ids=str,
)
def test_file_comes_back_the_same(changes: dict[str, Any], tmp_path: Path) -> None:
    settings = FilterSettings.for_robot("car", **changes)
    save_settings(settings, tmp_path / "safety.toml")
    assert load_settings(tmp_path / "safety.toml") == settings
    assert parse_settings(write_settings(settings)) == settings


def test_keys_left_out_keep_their_defaults_and_a_nominal_action_may_be_believed_less_than_a_range_outside() -> None:
    settings = parse_settings('system = "car"\neta = 0.5\nepsilon = { obstacle = 0.03 }\nclearance = 0\n')
    assert settings == replace(FilterSettings.for_robot("car"), eta=0.5, epsilon={"obstacle": 0.03}).with_barriers(
        clearance=0.0
    )
    assert parse_settings('system = "car"\nepsilon = 0.03').epsilon == {"default": 0.03}
    assert parse_settings('system = "car"\nplausible_nominal = 0.5').plausible_nominal == 0.5


@pytest.mark.parametrize(
    ("text", "phrase"),
    [
        ("etta = 0.1", r"etta: unknown key; did you mean 'eta'\?"),
        ("eta = 0", "eta: got 0, wanted more than 0"),
        ("eta = 1.0000001", r"eta: got 1\.0000001, wanted more than 0\.0, at most 1"),
        ("eta = nan", "eta: got nan, wanted a finite number"),
        ("eta = true", "eta: got True"),
        ('eta = "high"', "eta: got 'high'"),
        ("epsilon = -0.1", r"epsilon\.default: got -0\.1"),
        ("epsilon = { obstacle = inf }", r"epsilon\.obstacle: got inf"),
        ("epsilon = { obstacle = 0.1, speed = -1.0 }", r"epsilon\.speed: got -1\.0, wanted at least 0"),
        ("margin = -0.1", r"margin: got -0\.1, wanted at least 0"),
        ("margin = inf", "margin: got inf, wanted a finite number"),
        ("margin = true", "margin: got True, wanted a finite number"),
        ('margin = "conformel"', "margin: got 'conformel', wanted a number >= 0, or .*conformal"),
        ('action_low = "ab"', "action_low: got 'ab', wanted a list of numbers"),
        ("action_high = [inf, 0.34]", "action_high: got inf, wanted a finite number"),
        ("action_low = [0.0]", "action_high: got 2 numbers, action_low has 1"),
        ("action_low = []\naction_high = []", "action_high: got 0 numbers"),
        ("action_low = [3.0, 0.0]", r"action_low: got 3\.0, wanted less than action_high 2\.0"),
        ("action_low = [2.0, 0.0]", r"action_low: got 2\.0, wanted less"),
        ("action_low = 3.0", r"action_low: got 3\.0, wanted a list of numbers"),
        ("action_low = [nan, 0.0]", "action_low: got nan"),
        ("weights = [1.0]", "weights: got 1 numbers, wanted 2 or none"),
        ("weights = [1.0, 0.0]", "weights: got .* wanted positive numbers"),
        ("weights = [-1.0, 1.0]", "weights: got .* wanted positive numbers"),
        ("backup_action = [-0.601, 0.0]", r"backup_action: got -0\.601, wanted -0\.6 to 2\.0"),
        ("backup_action = [0.0, 1.0]", r"backup_action: got 1\.0, wanted -0\.34 to 0\.34"),
        ("backup_action = [0.0]", "backup_action: got 1 numbers"),
        ("braking_gain = 0", "braking_gain: got 0"),
        ("plausible_nominal = 0", "plausible_nominal: got 0, wanted more than 0"),
        ("plausible_nominal = inf", "plausible_nominal: got inf, wanted a finite number"),
        ("speed_high = -0.8", r"speed_high: got -0\.8, wanted more than speed_low -0\.8"),
        (
            'system = "drone"\neta = 0.1',
            "action_low: missing; wanted the bounds of the actions, or the name of a robot",
        ),
        ('action_low = [-1.0]\nsystem = ""', "action_high: missing; wanted the bounds of the actions"),
        ('system = "pendulum"\netta = 0.1', "etta: unknown key"),
        ("clearance = -0.1", r"clearance: got -0\.1, wanted at least 0"),
        ("clearance = nan", "clearance: got nan, wanted "),
        ("speed_low = 3.0", r"speed_high: got 2\.2, wanted more than speed_low 3\.0"),
        ("relinearisations = 2.5", r"relinearisations: got 2\.5, wanted a whole number"),
        ("relinearisations = true", "relinearisations: got True"),
        ("relinearisations = -1", "relinearisations: got -1, wanted at least 0, at most 20"),
        ("relinearisations = 21", "relinearisations: got 21, wanted at least 0, at most 20"),
        ("enabled = 1", "enabled: got 1, wanted true or false"),
        ("format = 7", "format: wanted 2"),
        ("eta =", "not TOML"),
    ],
)
def test_errors_name_the_key(text: str, phrase: str, tmp_path: Path) -> None:
    text = text if "system" in text else f'system = "car"\n{text}'
    with pytest.raises(InputError, match=phrase):
        parse_settings(text)
    (tmp_path / "bad.toml").write_text(text)
    with pytest.raises(InputError, match=r"bad\.toml: "):
        load_settings(tmp_path / "bad.toml")


def test_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.toml: cannot be read"):
        load_settings(tmp_path / "none.toml")


@pytest.mark.parametrize("value", [np.array([0.5, 0.5]), [0.5, 0.5], (0.5, 0.5)])
def test_arrays_and_lists_become_tuples(value: Any) -> None:
    assert FilterSettings.for_robot("car", weights=value).weights == (0.5, 0.5)


def test_old_files_are_read_and_keys_of_other_robots_or_of_former_settings_say_nothing() -> None:
    """Every file held the numbers of all barriers; those of another robot never said anything."""
    old = "system = 'pendulum'\naction_low = [-1.0]\naction_high = [1.0]\nclearance = 0.2\ncorridor_seconds = 0.4\n"
    assert parse_settings(old).barriers == {"corridor_seconds": 0.4}
    assert parse_settings('system = "car"\ncorridor_seconds = 0.4\nclearance = 0.2').barrier("clearance") == 0.2


def test_numbers_of_barriers_that_a_robot_does_not_have_are_refused() -> None:
    with pytest.raises(InputError, match="corridor_seconds: no setting of the barriers of 'car'"):
        FilterSettings.for_robot("car", barriers={"corridor_seconds": 0.4})
    with pytest.raises(InputError, match="settings of 'car': no 'corridor_seconds' among them"):
        FilterSettings.for_robot("car").barrier("corridor_seconds")
    with pytest.raises(InputError, match=r"clearence: unknown key; .*clearance"):
        parse_settings('system = "car"\nclearence = 0.2')


def test_settings_of_no_named_robot_go_with_the_numbers_of_any_barrier() -> None:
    own = FilterSettings(action_low=(-1.0,), action_high=(1.0,), barriers={"clearance": 0.3})
    assert (own.barriers, own.barrier("clearance"), own.barrier("braking_gain")) == ({"clearance": 0.3}, 0.3, 2.5)
    assert parse_settings(write_settings(own)) == own
    # With bounds of its own a file speaks of no robot: numbers of any barrier are kept.
    both = "action_low = [-1.0]\naction_high = [1.0]\n"
    assert parse_settings(both + "corridor_seconds = 0.4").barriers == {"corridor_seconds": 0.4}
    assert parse_settings('system = "car"\ncorridor_seconds = 0.4') == FilterSettings.for_robot("car")


@pytest.mark.parametrize(
    "changes",
    [
        {"eta": 1e-300, "plausible_nominal": 1e-300, "relinearisations": 0},
        {"margin": "theorem", "epsilon": {"obstacle": 0}},
        {"margin": 1e9, "weights": (1e-300, 1e300), "epsilon": 0.0},
        {"action_low": (math.nextafter(2.0, 0.0), -0.34)},
    ],
    ids=str,
)
def test_settings_at_the_ends_of_their_ranges_come_back_from_their_file(changes: dict[str, Any]) -> None:
    settings = FilterSettings.for_robot("car", **changes)
    assert parse_settings(write_settings(settings)) == settings


@pytest.mark.parametrize(
    ("low", "high", "rests"),
    [
        ((-1.0, -2.0), (1.0, 2.0), [0.0, 0.0]),
        ((0.5, -2.0), (1.0, -1.0), [0.5, -1.0]),
        ((0.0, -2.0), (1.0, 0.0), [0.0, 0.0]),
    ],
)
def test_the_resting_action_is_the_admissible_one_nearest_to_zero_unless_a_backup_is_set(low, high, rests):
    found = FilterSettings(system="", action_low=low, action_high=high)
    assert found.resting_action.tolist() == rests
    assert found.weight_vector.tolist() == [1.0, 1.0]
    assert replace(found, backup_action=high).resting_action.tolist() == list(high)


@pytest.mark.parametrize("barriers", [1.0, ["clearance"], {"clearanse": 0.1}], ids=str)
def test_settings_of_barriers_are_known_numbers_by_name(barriers: Any) -> None:
    with pytest.raises(InputError, match=r"barriers: got .*, wanted numbers by name|clearanse: .*clearance"):
        FilterSettings.for_robot("car", barriers=barriers)


@pytest.mark.parametrize("backup", [(-0.6, -0.34), (2.0, 0.34)])
def test_what_lies_on_a_limit_is_within_it(backup: tuple[float, float]) -> None:
    settings = FilterSettings.for_robot("car", backup_action=backup, eta=1.0, relinearisations=20, margin=0.0)
    assert settings.resting_action.tolist() == list(backup)
    assert parse_settings(write_settings(settings)) == settings
    assert FilterSettings.for_robot("car", margin=0.5).margin == 0.5
