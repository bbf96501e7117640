"""A margin is of steps of one length: over longer ones it is taken wider, promises nothing, and says so."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.safety.node_steps import CAR, SETTINGS, asked, latent_at, scripted_node, stamp, state_at

from safedpa.adaptation import AdaptationNode
from safedpa.bus import LATENT as LATENTS
from safedpa.bus import NOMINAL, TAKEOVER, LatentMessage, ModelMessage, NominalMessage, ReceivedMessage
from safedpa.bus import STATE as STATES
from safedpa.bus.messages.codec import encode
from safedpa.bus.messages.topics import key_of
from safedpa.calibration.from_drives import DriveTick, barrier_residuals
from safedpa.calibration.from_recordings import calibration_from_recordings
from safedpa.dynamics import fingerprint, parse_model, write_model
from safedpa.errors import InputError
from safedpa.policy import PolicyNode
from safedpa.records import McapRecorder
from safedpa.runtime.calibrated_model import CalibratedModel, uncalibrated
from safedpa.safety import MarginCalibration
from safedpa.safety.defaults import margin_for
from safedpa.safety.margins.calibration import calibration_from_errors, margin_from_text, margin_text
from safedpa.safety.settings import FilterSettings
from safedpa_sim.closed_loop import drive
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene

QUICK = 0.005
EPSILON = {"obstacle": 0.003, "field": 0.002, "speed": 0.005}
WIDEST = 0.005
"""What a verdict reports."""
OF_QUICK_STEPS = MarginCalibration(EPSILON, 0.99, 500, "2026-11-28", fingerprint(CAR), period=QUICK)
LONGER = "A step is 10 times as long as those that the margin was calibrated on"


def answered(calibration: MarginCalibration | None, period: float = 0.05, settings: FilterSettings = SETTINGS):
    node, state = scripted_node(CAR, settings, calibration), state_at(0, period=period)
    return node, asked(node, state, latent_at(state))


def test_over_ten_times_as_long_steps_it_is_ten_times_as_wide_and_promises_nothing() -> None:
    _, verdict = answered(OF_QUICK_STEPS)
    assert verdict.margin == pytest.approx(10.0 * WIDEST)
    assert LONGER in verdict.sentence
    assert "calibrate it at this period" in verdict.sentence
    assert verdict.promised == -1.0


@pytest.mark.parametrize("period", [QUICK, 1.009 * QUICK, 0.5 * QUICK])
def test_over_steps_as_long_or_shorter_it_stays_what_it_is(period: float) -> None:
    _, verdict = answered(OF_QUICK_STEPS, period)
    assert verdict.margin == WIDEST
    assert "times as long" not in verdict.sentence
    assert verdict.promised == 0.99


def test_one_that_does_not_say_is_of_the_models_own_steps() -> None:
    silent = replace(OF_QUICK_STEPS, period=0.0)
    _, verdict = answered(silent)
    assert (verdict.margin, verdict.promised) == (WIDEST, 0.99)
    _, verdict = answered(silent, 0.1)
    assert verdict.margin == pytest.approx(2.0 * WIDEST)
    assert "A step is 2 times as long" in verdict.sentence


def test_margins_that_were_not_calibrated_are_taken_as_they_are() -> None:
    _, verdict = answered(None, 0.5)
    assert verdict.margin == 0.01
    assert "times as long" not in verdict.sentence
    _, verdict = answered(OF_QUICK_STEPS, settings=replace(SETTINGS, margin=0.02))
    assert verdict.margin == 0.02
    assert "times as long" not in verdict.sentence
    own = CalibratedModel(CAR, "own", uncalibrated(SETTINGS, "own"))
    assert own.margin_over(5.0, SETTINGS) == (own.calibration, 1.0)


def test_the_margin_that_the_settings_choose_is_widened_and_of_one_of_no_step_nothing_is_known() -> None:
    whole = replace(OF_QUICK_STEPS, drive={kind: 2.0 * value for kind, value in EPSILON.items()})
    _, verdict = answered(whole, settings=replace(SETTINGS, margin="drive"))
    assert verdict.margin == pytest.approx(20.0 * WIDEST)
    whole = replace(OF_QUICK_STEPS, drive=dict.fromkeys(EPSILON, 0.1), slower={"0.1": dict.fromkeys(EPSILON, 0.2)})
    assert whole.select("drive").slower == {}
    assert whole.select("conformal") is whole


def test_a_robot_that_goes_on_slower_does_not_keep_the_margin_of_its_quick_steps() -> None:
    """Nor what the watch made of it: the wider one comes into force as h allows, as with a new model."""
    node, verdict = answered(OF_QUICK_STEPS, QUICK)
    assert verdict.promised == 0.99
    state = state_at(1, period=0.05, applied=verdict.action)
    verdict = asked(node, state, latent_at(state))
    assert LONGER in verdict.sentence
    assert verdict.promised == -1.0
    for tick in range(2, 30):  # far from everything: as a whole
        state = state_at(tick, period=0.05, applied=verdict.action)
        verdict = asked(node, state, latent_at(state))
    assert verdict.margin == pytest.approx(10.0 * WIDEST)


@pytest.mark.parametrize(("slow", "then"), [(0.1, QUICK), (0.1, 0.05)])
def test_a_robot_that_goes_on_quicker_is_not_held_to_what_its_long_steps_took(slow: float, then: float) -> None:
    """Nor does the verdict mention how long they were."""
    node, verdict = answered(OF_QUICK_STEPS, slow)
    assert f"A step is {slow / QUICK:g} times" in verdict.sentence
    state = state_at(1, period=then, applied=verdict.action)
    verdict = asked(node, state, latent_at(state))
    assert f"A step is {slow / QUICK:g} times" not in verdict.sentence
    times = then / QUICK
    assert verdict.margin == pytest.approx(times * WIDEST)
    assert verdict.promised == (0.99 if times == 1.0 else -1.0)


def test_what_an_offered_margin_would_bring_is_reported_for_the_robots_own_period() -> None:
    document = write_model(CAR) + '\n[[effects]]\nname = "steering_offset"\nangle = 0.01\n'
    new = fingerprint(parse_model(document))
    margin = margin_text(replace(OF_QUICK_STEPS, epsilon={**EPSILON, "obstacle": 0.02}, fingerprint=new))
    for calibration, sent, expected_effect in (
        (OF_QUICK_STEPS, margin, "obstacle goes from 0.03 to 0.2"),
        (None, "", ""),
    ):
        node, verdict = answered(calibration)
        state = state_at(1, applied=verdict.action)
        offer = {"step": "offer", "change": 1, "fingerprint": new, "replaces": fingerprint(CAR)}
        node.hear("r", ModelMessage(**stamp(state), **offer, document=document, margin=sent))
        nominal = NominalMessage(**stamp(state), values=(1.0, 0.0), controller="test")
        node.step("r", state, {LATENTS: latent_at(state), NOMINAL: nominal})
        takeover = node.afterwards("r")[TAKEOVER]
        assert takeover.state == "ready", "where nothing was calibrated no margin is missed"
        assert expected_effect in takeover.expected_effect


TABLES = st.dictionaries(
    st.sampled_from(["0.1", "0.2", "1.5"]), st.fixed_dictionaries({kind: st.floats(0, 1) for kind in EPSILON})
)


@given(st.floats(1e-4, 10.0), st.floats(1e-4, 10.0), TABLES)
def test_a_longer_step_never_has_the_narrower_margin(one: float, other: float, slower: dict[str, Any]) -> None:
    calibration = replace(OF_QUICK_STEPS, slower=slower)
    (short, few), (long, many) = (calibration.for_period(period, 0.05) for period in sorted((one, other)))
    assert 1.0 <= few <= many
    assert all(EPSILON[kind] <= short.epsilon[kind] <= long.epsilon[kind] for kind in EPSILON)


def test_longer_steps_that_were_calibrated_have_what_was_measured_on_them() -> None:
    """Between two the longer one's; never less than that of shorter ones; beyond the last in proportion."""
    slower = {"0.2": dict.fromkeys(EPSILON, 0.02), "0.1": {"obstacle": 0.05, "field": 0.001, "speed": 0.01}}
    calibration = replace(OF_QUICK_STEPS, slower=slower)
    reported = {period: calibration.for_period(period, 0.05) for period in (QUICK, 0.05, 0.1, 0.11, 0.2, 0.4)}
    assert [times for _, times in reported.values()] == pytest.approx([1.0, 1.0, 1.0, 1.0, 1.0, 2.0])
    assert reported[QUICK][0].epsilon == EPSILON
    assert reported[0.05][0].epsilon == reported[0.1][0].epsilon == {"obstacle": 0.05, "field": 0.002, "speed": 0.01}
    assert reported[0.11][0].epsilon == reported[0.2][0].epsilon == {"obstacle": 0.05, "field": 0.02, "speed": 0.02}
    assert reported[0.4][0].epsilon == {"obstacle": 0.1, "field": 0.04, "speed": 0.04}
    _, verdict = answered(calibration, 0.1)
    assert (verdict.margin, verdict.promised) == (0.05, 0.99)
    assert "times as long" not in verdict.sentence
    assert MarginCalibration.parse(calibration.write()) == calibration
    assert margin_from_text(margin_text(calibration)) == calibration
    assert calibration.select(0.02).slower == {}
    narrower = replace(OF_QUICK_STEPS, period=0.0, slower={"0.05": dict.fromkeys(EPSILON, 0.0)})
    assert narrower.for_period(0.05, 0.05)[0].epsilon == EPSILON, "a table of the same steps takes nothing away"


@pytest.mark.parametrize(
    ("slower", "notice"),
    [
        ([], r"slower: got \[\], wanted a table of margins for each period in s"),
        ({"0.1": {"obstacle": 0.1}}, r"slower\.0\.1: got obstacle, wanted numbers for obstacle, field, speed"),
        ({"0.1": 0.3}, r"slower\.0\.1: got 0\.3, wanted numbers for"),
        ({"0.1": {**EPSILON, "speed": -0.1}}, r"slower\.0\.1\.speed: got -0\.1, wanted a finite number >= 0"),
        ({"soon": EPSILON}, r"slower\.soon: wanted a period in s for the name of the table"),
        ({"0.001": EPSILON}, r"slower\.0\.001: got 0\.001, wanted a finite number >= 0\.005"),
        ({"inf": EPSILON}, r"slower\.inf: got inf, wanted a finite number"),
    ],
)
def test_tables_of_longer_steps_are_checked(slower: Any, notice: str) -> None:
    with pytest.raises(InputError, match=f"^{notice}"):
        replace(OF_QUICK_STEPS, slower=slower)


def test_file_and_text_keep_the_period() -> None:
    assert MarginCalibration.parse(OF_QUICK_STEPS.write()) == OF_QUICK_STEPS
    assert margin_from_text(margin_text(OF_QUICK_STEPS)) == OF_QUICK_STEPS
    assert "period" not in replace(OF_QUICK_STEPS, period=0.0).write()
    errors = {"obstacle": np.linspace(0.0, 0.01, 200)}
    assert (
        calibration_from_errors(errors, 0.9, "2026-11-28", "f").period
        == MarginCalibration(EPSILON, 0.9, 1, "", "f").period
        == 0.0
    )


def test_heights_of_a_drive_of_no_tick_are_none_and_a_step_longer_by_its_own_spread_is_as_long() -> None:
    assert barrier_residuals(CAR, SETTINGS, []) == {}
    assert barrier_residuals(CAR, SETTINGS, driven_ticks(0.05, 0.05)) == {}
    assert OF_QUICK_STEPS.for_period(1.01 * QUICK, 0.05) == (OF_QUICK_STEPS, 1.0)
    assert OF_QUICK_STEPS.for_period(1.02 * QUICK, 0.05)[1] == pytest.approx(1.02)


@pytest.mark.parametrize("name", ["car", "car_learned", "car_measured", "pendulum", "differential_drive"])
def test_the_shipped_ones_say_their_models_period(name: str) -> None:
    from safedpa.dynamics import load_model

    model = load_model(name)
    calibration = margin_for(model)
    assert calibration is not None
    assert calibration.period == model.period


def driven_ticks(period: float, seconds: float, seed: int = 3) -> list[DriveTick]:
    robot = CarRobot(Scene.random(seed, "none"), period)
    nodes = [AdaptationNode(CAR), PolicyNode(CAR), scripted_node(CAR, SETTINGS, margin_for(CAR))]
    latents: dict[int, LatentMessage] = {}

    def hear(item: ReceivedMessage) -> None:
        if isinstance(item.message, LatentMessage):
            latents[item.message.tick] = item.message

    states = [made.state for made in drive(robot, nodes, round(seconds / period), hear=hear)]
    return [DriveTick(state, latents.get(state.tick)) for state in states]


def written(path: Path, *drives: list[DriveTick]) -> Path:
    with McapRecorder(path) as recorder:
        for number, ticks in enumerate(drives):
            for one in ticks:
                for topic, message in ((STATES, one.state), (LATENTS, one.latent)):
                    if message is not None:
                        sent: Any = replace(message, epoch=number + 1)
                        moment = round(1e9 * one.state.robot_time)
                        recorder.write(key_of("fleet", "r", topic), encode(sent), moment, moment)
    return path


def test_a_calibration_says_of_which_steps_it_is_and_takes_them_alone(tmp_path: Path) -> None:
    quick, usual = driven_ticks(0.01, 8.0), driven_ticks(0.05, 8.0)
    path = written(tmp_path / "quick.mcap", quick)
    found = calibration_from_recordings(CAR, SETTINGS, [path], 0.9, "2026-11-28")
    assert found.period == 0.01
    between = [one._replace(state=replace(one.state, period=0.02)) for one in usual[:3]]
    other = written(tmp_path / "both.mcap", usual, between, quick)
    with pytest.raises(InputError, match=r"recordings: got steps of 0\.01 and 0\.05 s, wanted one period; calibrate"):
        calibration_from_recordings(CAR, SETTINGS, [other], 0.9, "2026-11-28")
    own = calibration_from_recordings(CAR, SETTINGS, [written(tmp_path / "b.mcap", usual)], 0.9, "2026-11-28")
    assert own.period == 0.05
    # by norms: a whole step ahead of a fifth of one would be wrong by what the robot goes in the rest of it
    assert found.constants["scale.x"] < own.constants["scale.x"] < 0.01


def test_heights_of_quick_drives_are_predicted_over_quick_steps() -> None:
    """A tenth of a step ahead the prediction is nearer than a whole one, not ten times as far away."""
    quick = barrier_residuals(CAR, SETTINGS, driven_ticks(QUICK, 4.0))
    usual = barrier_residuals(CAR, SETTINGS, driven_ticks(0.05, 4.0))

    def worst(heights: dict[str, Any]) -> float:
        return float(abs(heights["obstacle"][:, 0] - heights["obstacle"][:, 1]).max())

    assert worst(quick) < worst(usual)
