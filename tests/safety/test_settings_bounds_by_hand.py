"""Settings, calibrations and inputs at the ends of their ranges: beyond is refused with its key, within passes."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from safedpa.errors import InputError
from safedpa.safety.calibration import MarginCalibration, calibration_from_errors, one_step_errors
from safedpa.safety.inputs import Plausible, checked_names
from safedpa.safety.margin import OnlineMargin, margins_over_drives, smallest_sample, split_conformal_margin
from safedpa.safety.prediction import Prediction
from safedpa.safety.settings import FilterSettings, parse_settings

OWN: dict[str, Any] = {"system": "", "action_low": (-1.0, 0.0), "action_high": (1.0, 2.0)}

REFUSED_SETTINGS: dict[str, tuple[dict[str, Any], str]] = {
    "eta 0": ({"eta": 0.0}, "eta: got 0.0, wanted more than 0.0, at most 1.0"),
    "eta below 0": ({"eta": -0.1}, "eta: got -0.1, wanted more than 0.0, at most 1.0"),
    "eta above 1": ({"eta": 1.0000001}, "eta: got 1.0000001, wanted more than 0.0, at most 1.0"),
    "eta nan": ({"eta": math.nan}, "eta: got nan, wanted a finite number"),
    "eta true": ({"eta": True}, "eta: got True, wanted a finite number"),
    "plausible_wish 0": ({"plausible_wish": 0.0}, "plausible_wish: got 0.0, wanted more than 0.0"),
    "plausible_wish below 0": ({"plausible_wish": -1e-9}, "plausible_wish: got -1e-09, wanted more than 0.0"),
    "plausible_wish infinite": ({"plausible_wish": math.inf}, "plausible_wish: got inf, wanted a finite number"),
    "relinearisations below 0": ({"relinearisations": -1}, "relinearisations: got -1, wanted at least 0, at most 20"),
    "relinearisations 21": ({"relinearisations": 21}, "relinearisations: got 21, wanted at least 0, at most 20"),
    "relinearisations 1.0": ({"relinearisations": 1.0}, "relinearisations: got 1.0, wanted a whole number"),
    "relinearisations true": ({"relinearisations": True}, "relinearisations: got True, wanted a whole number"),
    "enabled 1": ({"enabled": 1}, "enabled: got 1, wanted true or false"),
    "enabled a text": ({"enabled": "true"}, "enabled: got 'true', wanted true or false"),
    "system none": ({"system": None}, "system: got None, wanted the name of a system, or '' for one of your own"),
    "margin below 0": ({"margin": -0.1}, "margin: got -0.1, wanted at least 0.0"),
    "margin infinite": ({"margin": math.inf}, "margin: got inf, wanted a finite number"),
    "margin unknown": ({"margin": "conformel"}, "margin: got 'conformel', wanted a number >= 0, or .*conformal"),
    "margin true": ({"margin": True}, "margin: got True, wanted a finite number"),
    "epsilon below 0": ({"epsilon": -0.1}, "epsilon.default: got -0.1, wanted at least 0.0"),
    "epsilon of a kind": ({"epsilon": {"obstacle": -1.0}}, "epsilon.obstacle: got -1.0, wanted at least 0.0"),
    "epsilon nan": ({"epsilon": {"a": 0.1, "b": math.nan}}, "epsilon.b: got nan, wanted a finite number"),
    "no actions": (
        {"action_low": (), "action_high": ()},
        "action_high: got 0 numbers, action_low has 0; wanted as many",
    ),
    "one bound more": ({"action_high": (1.0,)}, "action_high: got 1 numbers, action_low has 2; wanted as many"),
    "one bound less": (
        {"action_high": (1.0, 2.0, 3.0)},
        "action_high: got 3 numbers, action_low has 2; wanted as many",
    ),
    "equal bounds": ({"action_high": (1.0, 0.0)}, "action_low: got 0.0, wanted less than action_high 0.0"),
    "bounds turned": ({"action_low": (2.0, 0.0)}, "action_low: got 2.0, wanted less than action_high 1.0"),
    "bounds infinite": ({"action_high": (math.inf, 2.0)}, "action_high: got inf, wanted a finite number"),
    "bounds one number": ({"action_low": 0.0}, "action_low: got 0.0, wanted a list of numbers"),
    "bounds of text": ({"action_low": "ab"}, "action_low: got 'ab', wanted a list of numbers"),
    "one weight": ({"weights": (1.0,)}, "weights: got 1 numbers, wanted 2 or none"),
    "weight 0": ({"weights": (1.0, 0.0)}, r"weights: got \(1.0, 0.0\), wanted positive numbers"),
    "weight below 0": ({"weights": (-1.0, 1.0)}, r"weights: got \(-1.0, 1.0\), wanted positive numbers"),
    "three backup actions": ({"backup_action": (0.0, 0.0, 0.0)}, "backup_action: got 3 numbers, wanted 2 or none"),
    "backup above": ({"backup_action": (0.0, 2.001)}, "backup_action: got 2.001, wanted 0.0 to 2.0"),
    "backup below": ({"backup_action": (-1.001, 0.0)}, "backup_action: got -1.001, wanted -1.0 to 1.0"),
    "barriers a number": ({"barriers": 1.0}, "barriers: got 1.0, wanted numbers by name"),
    "barriers a list": ({"barriers": ["clearance"]}, r"barriers: got \['clearance'\], wanted numbers by name"),
    "barriers unknown": ({"barriers": {"clearanse": 0.1}}, "clearanse: no setting of the barriers of ''; .*clearance"),
}


@pytest.mark.parametrize("case", REFUSED_SETTINGS)
def test_a_setting_just_beyond_its_range_is_refused_with_its_key(case: str) -> None:
    changes, said = REFUSED_SETTINGS[case]
    with pytest.raises(InputError, match=f"^{said}"):
        FilterSettings(**{**OWN, **changes})


TAKEN_SETTINGS: tuple[dict[str, Any], ...] = (
    {"eta": 1.0},
    {"eta": 1e-300},
    {"plausible_wish": 1e-300},
    {"relinearisations": 0},
    {"relinearisations": 20},
    {"enabled": False},
    {"margin": 0.0},
    {"margin": 1e9},
    {"margin": "conformal"},
    {"margin": "drive"},
    {"margin": "theorem"},
    {"weights": (1e-300, 1e300)},
    {"weights": ()},
    {"backup_action": (-1.0, 2.0)},
    {"backup_action": (1.0, 0.0)},
    {"backup_action": ()},
    {"action_low": (-1.0, math.nextafter(2.0, 0.0))},
)


@pytest.mark.parametrize("changes", TAKEN_SETTINGS, ids=str)
def test_a_setting_at_the_end_of_its_range_is_kept_as_it_is(changes: dict[str, Any]) -> None:
    found = FilterSettings(**{**OWN, **changes})
    for name, value in changes.items():
        assert getattr(found, name) == value


def test_an_epsilon_of_0_is_one() -> None:
    assert FilterSettings(**{**OWN, "epsilon": 0.0}).epsilon == {"default": 0.0}
    assert FilterSettings(**{**OWN, "epsilon": {"obstacle": 0}}).epsilon == {"obstacle": 0.0}


@pytest.mark.parametrize(
    ("low", "high", "rests"),
    [
        ((-1.0, -2.0), (1.0, 2.0), [0.0, 0.0]),
        ((0.5, -2.0), (1.0, -1.0), [0.5, -1.0]),
        ((0.0, -2.0), (1.0, 0.0), [0.0, 0.0]),
    ],
)
def test_what_is_done_when_nothing_can_be_computed_is_0_or_what_lies_nearest(
    low: tuple[float, ...], high: tuple[float, ...], rests: list[float]
) -> None:
    found = FilterSettings(system="", action_low=low, action_high=high)
    assert found.resting_action.tolist() == rests
    assert found.weight_vector.tolist() == [1.0, 1.0]
    assert replace(found, backup_action=high, weights=(2.0, 3.0)).resting_action.tolist() == list(high)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("format = 2", "format: wanted 1; this program reads no other"),
        ('format = "1"', "format: wanted 1"),
        ("slack_tolerance = 0.1", "slack_tolerance: no setting any more, tolerances follow from each barrier's scale"),
        ("slack_linear = 0.1", "slack_linear: no setting any more"),
        ("etta = 0.1", "etta: unknown key; .*eta"),
        ('system = "pendulum"', "action_low: got none for the system 'pendulum', wanted its bounds: the defaults are"),
        ('system = "point"\nown_radius = 0.1', "^own_radius: unknown key"),
        ("clearance = nan", "clearance: got nan, wanted "),
        ("system = 1", "system: got 1, wanted the name of a system|action_low: got none for the system"),
    ],
)
def test_a_file_of_settings_is_refused_with_its_key(text: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        parse_settings(text)


GOOD: dict[str, Any] = {
    "epsilon": {"obstacle": 0.1},
    "coverage": 0.9,
    "transitions": 10,
    "date": "2026-11-27",
    "fingerprint": "abc",
}

REFUSED_CALIBRATIONS: dict[str, tuple[dict[str, Any], str]] = {
    "no kinds": ({"epsilon": {}}, "epsilon: got {}, wanted a table with a number for each kind of barrier"),
    "a number": ({"epsilon": 0.1}, "epsilon: got 0.1, wanted a table with a number for each kind"),
    "below 0": ({"epsilon": {"obstacle": -1e-9}}, "epsilon.obstacle: got -1e-09, wanted a finite number >= 0"),
    "nan": ({"epsilon": {"obstacle": math.nan}}, "epsilon.obstacle: got nan, wanted a finite number >= 0"),
    "infinite": ({"epsilon": {"obstacle": math.inf}}, "epsilon.obstacle: got inf, wanted a finite number >= 0"),
    "true": ({"epsilon": {"obstacle": True}}, "epsilon.obstacle: got True, wanted a finite number >= 0"),
    "a text": ({"epsilon": {"obstacle": "0.1"}}, "epsilon.obstacle: got '0.1', wanted a finite number >= 0"),
    "the second kind": ({"epsilon": {"obstacle": 0.1, "speed": -1.0}}, "epsilon.speed: got -1.0, wanted a finite"),
    "coverage 0": ({"coverage": 0.0}, "coverage: got 0.0, wanted more than 0 and less than 1"),
    "coverage 1": ({"coverage": 1.0}, "coverage: got 1.0, wanted more than 0 and less than 1"),
    "coverage below 0": ({"coverage": -0.1}, "coverage: got -0.1, wanted a finite number >= 0"),
    "coverage nan": ({"coverage": math.nan}, "coverage: got nan, wanted a finite number >= 0"),
    "coverage true": ({"coverage": True}, "coverage: got True, wanted a finite number"),
    "no transitions": ({"transitions": 0}, "transitions: got 0, wanted a finite number >= 1"),
    "drives below 0": ({"drives": -1}, "drives: got -1, wanted a finite number >= 0"),
    "drives infinite": ({"drives": math.inf}, "drives: got inf, wanted a finite number >= 0"),
    "date a number": ({"date": 2026}, "date: got 2026, wanted a string"),
    "fingerprint none": ({"fingerprint": None}, "fingerprint: got None, wanted a string"),
    "origin a number": ({"origin": 1}, "origin: got 1, wanted a string"),
    "drive a number": ({"drive": 0.1}, "drive: got 0.1, wanted a table of numbers"),
    "theorem a list": ({"theorem": [0.1]}, r"theorem: got \[0.1\], wanted a table of numbers"),
    "constants below 0": ({"constants": {"L": -1.0}}, "constants.L: got -1.0, wanted a finite number >= 0"),
    "covered infinite": ({"covered": {"conformal.a": math.inf}}, "covered.conformal.a: got inf, wanted a finite"),
    "drive below 0": ({"drive": {"obstacle": -0.5}}, "drive.obstacle: got -0.5, wanted a finite number >= 0"),
    "theorem nan": ({"theorem": {"obstacle": math.nan}}, "theorem.obstacle: got nan, wanted a finite number >= 0"),
}


@pytest.mark.parametrize("case", REFUSED_CALIBRATIONS)
def test_a_calibration_just_beyond_what_it_may_say_is_refused_with_its_key(case: str) -> None:
    changes, said = REFUSED_CALIBRATIONS[case]
    with pytest.raises(InputError, match=f"^{said}"):
        MarginCalibration(**{**GOOD, **changes})


@pytest.mark.parametrize(
    "changes",
    [
        {"epsilon": {"obstacle": 0}},
        {"coverage": 1e-9},
        {"coverage": math.nextafter(1.0, 0.0)},
        {"transitions": 1},
        {"drives": 0},
        {"origin": ""},
        {"drive": {"obstacle": 0.0}, "theorem": {"obstacle": 0.0}},
    ],
    ids=str,
)
def test_a_calibration_at_the_end_of_what_it_may_say_comes_back_from_its_file(changes: dict[str, Any]) -> None:
    made = MarginCalibration(**{**GOOD, **changes})
    assert MarginCalibration.parse(made.write()) == made


@pytest.mark.parametrize("margin", ["drive", "theorem"])
def test_a_margin_that_settings_name_is_there_for_each_kind(margin: str) -> None:
    """For one too few or another one it is not."""
    epsilon = {"obstacle": 0.1, "speed": 0.2}
    whole = MarginCalibration(**{**GOOD, "epsilon": epsilon, margin: {"speed": 0.4, "obstacle": 0.3}})
    assert whole.chosen(margin).epsilon == {"obstacle": 0.3, "speed": 0.4}
    assert whole.chosen("conformal").epsilon == epsilon
    assert whole.chosen(0.7).epsilon == {"obstacle": 0.7, "speed": 0.7}
    for table in ({}, {"obstacle": 0.3}, {"obstacle": 0.3, "corridor": 0.4}, {**epsilon, "corridor": 0.1}):
        one = MarginCalibration(**{**GOOD, "epsilon": epsilon, margin: table})
        with pytest.raises(
            InputError, match=f"margin '{margin}': the calibration has it for .*, wanted obstacle, speed"
        ):
            one.chosen(margin)


@pytest.mark.parametrize("key", ["format", "coverage", "transitions", "date", "fingerprint", "epsilon"])
def test_every_key_of_a_file_of_margins_is_wanted(key: str) -> None:
    lines = MarginCalibration(**GOOD).write().splitlines()
    kept = [line for line in lines if not line.startswith((key, f"[{key}]", '"obstacle"' if key == "epsilon" else "-"))]
    with pytest.raises(InputError, match=f"^{key}: missing; wanted the keys format, coverage, transitions, date,"):
        MarginCalibration.parse("\n".join(kept))


def test_a_file_of_margins_has_no_other_key_and_one_format() -> None:
    text = MarginCalibration(**GOOD).write()
    with pytest.raises(InputError, match=r"^epsilom: unknown key; .*epsilon"):
        MarginCalibration.parse(f"{text}\n[epsilom]\na = 1.0\n")
    with pytest.raises(InputError, match=r"^format: wanted 1; this program reads no other"):
        MarginCalibration.parse(text.replace("format = 1", "format = 2"))


@pytest.mark.parametrize(
    ("coverage", "least"), [(0.5, 1), (0.51, 2), (0.75, 3), (0.8, 4), (0.9, 9), (0.95, 19), (0.99, 99), (0.01, 1)]
)
def test_so_few_transitions_suffice_and_one_less_does_not(coverage: float, least: int) -> None:
    """coverage / (1 - coverage), rounded up; of so few the largest error is the margin."""
    assert smallest_sample(coverage) == least
    errors = np.arange(1.0, least + 1.0)
    found = calibration_from_errors({"a": errors, "b": -errors}, coverage, "", "")
    assert found.epsilon == {"a": float(least), "b": 0.0}
    assert found.transitions == least
    with pytest.raises(InputError, match=f"transitions: got {least - 1}, wanted at least {least} for a coverage of"):
        calibration_from_errors({"a": errors, "b": errors[:-1]}, coverage, "", "")


@pytest.mark.parametrize("coverage", [0.0, 1.0, -0.1, 1.1, math.nan, math.inf])
def test_a_coverage_lies_between_0_and_1(coverage: float) -> None:
    for asked in (
        lambda: split_conformal_margin([1.0], coverage),
        lambda: margins_over_drives([[1.0]], coverage),
        lambda: smallest_sample(coverage),
        lambda: OnlineMargin(0.1, coverage),
    ):
        with pytest.raises(InputError, match=r"coverage"):
            asked()


@pytest.mark.parametrize("drives", [[[1.0], []], [[1.0], [math.nan]], [[math.inf]], [[[1.0]]], [1.0]])
def test_errors_of_a_drive_are_one_axis_of_finite_numbers(drives: list[Any]) -> None:
    with pytest.raises(InputError, match=r"errors of a drive: got shape .* or NaN, wanted one axis of finite numbers"):
        margins_over_drives(drives, 0.5)


def test_margins_over_no_drives_and_over_one() -> None:
    """Of one drive at coverage 0.5: half of its steps twice, so all of them; the largest error for the whole drive."""
    assert margins_over_drives([], 0.5) == (math.inf, math.inf)
    assert margins_over_drives([[1.0, 3.0, 2.0]], 0.5) == (3.0, 3.0)
    assert margins_over_drives([[1.0, 3.0, 2.0]], 0.51) == (math.inf, math.inf)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"calibrated": -1e-9}, "calibrated margin: got -1e-09, wanted a finite number >= 0"),
        ({"calibrated": math.inf}, "calibrated margin: got inf"),
        ({"calibrated": math.nan}, "calibrated margin: got nan"),
        ({"rate": 0.0}, "rate 0.0, window 200: wanted 0 < rate <= 1 and window >= 1"),
        ({"rate": 1.0001}, "rate 1.0001, window 200: wanted"),
        ({"rate": math.nan}, "rate nan, window 200: wanted"),
        ({"window": 0}, "rate 0.02, window 0: wanted"),
    ],
)
def test_a_margin_that_follows_is_refused_beyond_its_ranges(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(InputError, match=said):
        OnlineMargin(**{"calibrated": 0.1, "coverage": 0.9, **changes})
    within: dict[str, Any]
    for within in ({"calibrated": 0.0}, {"rate": 1.0}, {"rate": 1e-9}, {"window": 1}):
        given: dict[str, Any] = {"calibrated": 0.1, "coverage": 0.9, **within}
        assert OnlineMargin(**given).value in (0.0, 0.1)


SHAPES: dict[str, tuple[Any, Any, Any, Any]] = {
    "states of one axis": (np.zeros(4), np.zeros((1, 2)), np.zeros(4), None),
    "another number of following states": (np.zeros((2, 4)), np.zeros((2, 2)), np.zeros((1, 4)), None),
    "actions of one axis": (np.zeros((2, 4)), np.zeros(2), np.zeros((2, 4)), None),
    "fewer actions": (np.zeros((2, 4)), np.zeros((1, 2)), np.zeros((2, 4)), None),
    "none": (np.zeros((0, 4)), np.zeros((0, 2)), np.zeros((0, 4)), None),
    "latents of one axis": (np.zeros((2, 4)), np.zeros((2, 2)), np.zeros((2, 4)), np.zeros(2)),
    "fewer latents": (np.zeros((2, 4)), np.zeros((2, 2)), np.zeros((2, 4)), np.zeros((1, 3))),
}


def standing() -> Prediction:
    """Of a robot that stays where it is."""
    return Prediction(lambda x: (x, np.zeros((4, 2))))


@pytest.mark.parametrize("case", SHAPES)
def test_transitions_that_do_not_fit_each_other_are_refused(case: str) -> None:
    states, actions, following, latents = SHAPES[case]
    said = "latents: got shape" if latents is not None else "transitions: got shapes"
    with pytest.raises(InputError, match=f"^{said} .*, wanted "):
        one_step_errors(standing(), (), states, actions, following, latents)


def test_without_a_barrier_there_is_no_margin() -> None:
    with pytest.raises(InputError, match=r"^barriers: got none, wanted at least one"):
        one_step_errors(standing(), (), np.zeros((2, 4)), np.zeros((2, 2)), np.zeros((2, 4)))


def test_what_is_believed_is_no_nan_and_names_are_text() -> None:
    for low, high in ((math.nan, 1.0), (0.0, math.nan)):
        with pytest.raises(ValueError, match=r"plausible range: got NaN"):
            Plausible(np.array([low]), np.array([high]), ("a",))
    assert Plausible(np.array([-np.inf]), np.array([np.inf]), ("a",)).highest == (math.inf,)
    assert checked_names(()) == ()
    assert checked_names([]) == ()
    assert checked_names(["a", "b"]) == ("a", "b")
    assert checked_names(frozenset({"a"})) == ("a",)
    for bad in ("ab", None, {"a": 1}, ["a", 1], (b"a",), [None], 1):
        assert checked_names(bad) is None
