"""The adaptation's step: deterministic, patient with gaps, deaf to what cannot be."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from safedpa.adaptation import AdaptationNode, EstimatorSettings
from safedpa.bus import LATENT, LatentMessage, StateMessage
from safedpa.dynamics import fingerprint, parse_model
from safedpa.errors import InputError, MessageError

MODEL = parse_model(
    """
    format = 1
    robot = "car"
    [base]
    kind = "kinematic_bicycle"
    drive = "speed_servo"
    wheelbase = 0.32
    speed_gain = 4.0
    acceleration_limit = 5.0
    [[effects]]
    name = "towed_load"
    mass_ratio = { value = 0.0, free = true }
    deceleration = 2.5
    """
)


def state(tick: int, values: tuple[float, ...], applied: tuple[float, ...], **changes: Any) -> StateMessage:
    fixed: dict[str, Any] = {
        "epoch": 1,
        "robot_time": 0.05 * tick,
        "publish_time": 0.0,
        "applied_by": "filter",
        "period": 0.05,
        "lockstep": True,
        "goal": (1.0, 1.0),
        "obstacles": (),
        "field": (-4.0, 4.0, -4.0, 4.0),
        "footprint": (0.08, 0.4, 0.12),
    }
    return StateMessage(tick=tick, values=values, applied=applied, **{**fixed, **changes})


def drive(count: int, ratio: float = 0.6) -> list[StateMessage]:
    """States of a loaded car whose target speed steps up and down."""
    values, action, found = np.zeros(4), np.zeros(2), []
    for tick in range(count):
        found.append(state(tick, tuple(values.tolist()), tuple(action.tolist())))
        action = np.array([1.6 if tick // 20 % 2 == 0 else 0.4, 0.1])
        values = MODEL.step(values, action, np.array([ratio]))
    return found


def answers(node: AdaptationNode, states: list[StateMessage], robot: str = "r") -> list[LatentMessage]:
    found = []
    for message in states:
        latent = node.step(robot, message, {})[LATENT]
        assert node.afterwards(robot) == {}
        assert isinstance(latent, LatentMessage)
        found.append(dataclasses.replace(latent, publish_time=0.0))
    return found


def test_it_finds_the_load_and_stamps_the_answer() -> None:
    states = drive(150)
    found = answers(AdaptationNode(MODEL), states)
    assert found[-1].values[0] == pytest.approx(0.6, abs=0.1)
    for asked, latent in zip(states, found, strict=True):
        assert (latent.epoch, latent.tick, latent.robot_time) == (asked.epoch, asked.tick, asked.robot_time)
        assert latent.model == fingerprint(MODEL)
        assert len(latent.values) == len(latent.deviations) == len(MODEL.latent_names)


def test_the_same_states_give_the_same_answers() -> None:
    states = drive(80)
    assert answers(AdaptationNode(MODEL), states) == answers(AdaptationNode(MODEL), states)


def test_robots_are_kept_apart() -> None:
    node = AdaptationNode(MODEL)
    loaded, free = drive(150, 0.8), drive(150, 0.0)
    together = [
        (answers(node, [one], "a")[0], answers(node, [two], "b")[0]) for one, two in zip(loaded, free, strict=True)
    ]
    assert [pair[0] for pair in together] == answers(AdaptationNode(MODEL), loaded)
    assert [pair[1] for pair in together] == answers(AdaptationNode(MODEL), free)


def test_an_answer_holds_what_was_learned_before_its_state() -> None:
    states = drive(60)
    straight = answers(AdaptationNode(MODEL), states)
    node = AdaptationNode(MODEL)
    answers(node, states[:40])
    odd = dataclasses.replace(states[40], values=(0.0, 0.0, 0.0, 1.0))
    assert answers(node, [odd])[0] == straight[40], "nobody waits for what the newest state teaches"


def test_over_a_gap_in_the_ticks_nothing_is_learned() -> None:
    states = drive(100)
    node = AdaptationNode(MODEL)
    answers(node, states[:50])
    before, after = answers(node, states[70:72])
    assert (after.values, after.deviations) == (before.values, before.deviations)
    assert answers(node, states[72:])[-1].values[0] == pytest.approx(0.6, abs=0.15)


def test_a_state_that_cannot_be_is_answered_and_not_learned() -> None:
    states = drive(60)
    node = AdaptationNode(MODEL)
    answers(node, states[:30])
    glitches = [
        dataclasses.replace(states[30], values=(0.0, 0.0, 0.0, 500.0)),
        dataclasses.replace(states[31], values=(1e11, 0.0, 0.0, 0.0)),
    ]
    shown = [(latent.values, latent.deviations) for latent in answers(node, [*glitches, *states[32:34]])]
    assert shown == shown[:1] * 4, "neither the glitches nor the step out of them are transitions"
    assert np.isfinite(answers(node, states[34:])[-1].values).all()


def test_a_state_that_is_no_number_is_never_learned() -> None:
    """The codec refuses it on the bus; a node that is called directly takes it as a state that cannot be."""
    node = AdaptationNode(MODEL)
    states = drive(32)
    answers(node, states[:30])
    broken = state(30, (float("nan"), 0.0, 0.0, 0.0), (0.0, 0.0))
    before, after = answers(node, [broken, states[31]])
    assert (after.values, after.deviations) == (before.values, before.deviations)


@pytest.mark.parametrize(("values", "applied"), [((0.0,) * 3, (0.0,) * 2), ((0.0,) * 4, (0.0,)), ((), ())])
def test_a_state_of_the_wrong_length_is_refused(values: tuple[float, ...], applied: tuple[float, ...]) -> None:
    with pytest.raises(MessageError, match=r"wanted 4 \(x, y, yaw, speed\) and 2"):
        AdaptationNode(MODEL).step("r", state(0, values, applied), {})


def test_forgotten_means_as_at_the_start() -> None:
    node = AdaptationNode(MODEL)
    first = answers(node, drive(50))
    node.forget("r")
    node.forget("never seen")
    assert answers(node, drive(50)) == first


def test_settings_that_do_not_fit_the_model_are_refused_before_any_robot_comes() -> None:
    with pytest.raises(InputError, match="measurement_deviation"):
        AdaptationNode(MODEL, EstimatorSettings(measurement_deviation=(0.1, 0.1)))
