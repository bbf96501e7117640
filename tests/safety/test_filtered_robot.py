"""What the filter's service makes of one robot's messages, tick by tick, beside what is said of it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tests.safety.node_steps import ABSENT, CAR, SETTINGS, asked, latent_at, memory_of, state_at

from safedpa.bus import ACTION, VERDICT, StateMessage, VerdictMessage
from safedpa.dynamics import fingerprint
from safedpa.safety.filtered_robot import too_late
from safedpa.safety.node import SafetyFilterNode
from safedpa.safety.scene import AbstractScene
from safedpa.safety.trail import LONGEST_AGE


@pytest.mark.parametrize(("seconds", "good"), [(0.0, True), (LONGEST_AGE, True), (-1e-9, False), (1.0 + 1e-9, False)])
def test_how_old_a_state_may_be_where_its_action_acts(seconds: float, good: bool) -> None:
    assert (too_late(state_at(0, until_action=seconds)) == []) is good


def test_a_latent_stands_in_for_the_missing_ones_of_a_second() -> None:
    node = SafetyFilterNode(CAR, SETTINGS)
    assert asked(node, state_at(0), latent_at(state_at(0))).status == "passed"
    for tick in range(1, 24):
        verdict = asked(node, state_at(tick), ABSENT)
        if tick <= 20:
            assert verdict.status == "passed", tick
        else:
            assert verdict.status == "fallback", tick
            assert "the latent (none of the last second has arrived)" in verdict.sentence


def test_a_latent_of_another_run_or_another_model_is_none() -> None:
    node = SafetyFilterNode(CAR, SETTINGS)
    asked(node, state_at(0), latent_at(state_at(0)))
    verdict = asked(node, state_at(1, epoch=2), ABSENT)
    assert (verdict.status, "none of the last second" in verdict.sentence) == ("fallback", True)
    verdict = asked(node, state_at(2), replace(latent_at(state_at(2)), model="another"))
    assert verdict.status == "fallback"
    assert f"the latent (of model another, the filter has {fingerprint(CAR)})" in verdict.sentence


def test_the_path_is_told_with_every_fourth_tick_and_the_next_state_with_each() -> None:
    node = SafetyFilterNode(CAR, SETTINGS)
    for tick in range(9):
        state = state_at(tick)
        verdict = asked(node, state, latent_at(state))
        wanted, _ = CAR.held(np.array(state.values), np.array(verdict.action), (), CAR.latent, 8, period=0.05)
        assert len(verdict.predicted) == (8 if tick % 4 == 0 else 1)
        np.testing.assert_allclose(verdict.predicted, wanted[: len(verdict.predicted)], atol=1e-12)


def test_of_a_state_of_another_size_nothing_is_foretold() -> None:
    node = SafetyFilterNode(CAR, SETTINGS)
    state = state_at(0, (0.0, 0.0, 0.0))
    verdict = asked(node, state, latent_at(state))
    assert (verdict.status, verdict.predicted) == ("fallback", ())


@pytest.mark.parametrize(("speed", "still"), [(0.02, True), (-0.02, True), (0.021, False), (-0.021, False)])
def test_who_is_slow_enough_after_an_order_stands(speed: float, still: bool) -> None:
    node = SafetyFilterNode(CAR, SETTINGS)
    assert not node.at_rest("r")
    state = state_at(0, (0.0, 0.0, 0.0, speed))
    asked(node, state, latent_at(state))
    assert not node.at_rest("r"), "nobody ordered it"
    asked(node, state_at(1, (0.0, 0.0, 0.0, speed)), replace(latent_at(state), model="another"))
    assert node.at_rest("r") is still, "the backup brakes it as well"


class Scene(AbstractScene):
    """A scene with a backup of its own."""

    def __init__(self, backup: Any) -> None:
        self.backup = backup

    def of(self, state: StateMessage) -> str:
        return "scene"


def failing(state: Any) -> Any:
    raise RuntimeError("no backup")


@pytest.mark.parametrize(
    ("backup", "wanted"),
    [
        (None, (0.0, 0.0)),
        (failing, (0.0, 0.0)),
        (lambda _: np.zeros(3), (0.0, 0.0)),
        (lambda _: (np.nan, 0.1), (0.0, 0.0)),
        (lambda _: (0.1, np.inf), (0.0, 0.0)),
        (lambda _: (-0.3, 0.1), (-0.3, 0.1)),
        (lambda _: (9.0, -9.0), (2.0, -0.34)),
    ],
)
def test_where_a_step_raised_the_scene_s_backup_is_what_is_left(backup: Any, wanted: tuple[float, float]) -> None:
    node = SafetyFilterNode(CAR, SETTINGS)
    state = state_at(0)
    outputs = node.rescue("r", state, "the filter raised")
    assert outputs[ACTION].values == (0.0, 0.0), "of a robot that nothing is known of"
    asked(node, state, latent_at(state))
    memory_of(node).scene = Scene(backup)
    for _ in range(2):
        outputs = node.rescue("r", state, "the filter raised")
        assert outputs[ACTION].values == pytest.approx(wanted)
        verdict = outputs[VERDICT]
        assert isinstance(verdict, VerdictMessage)
        assert (verdict.status, verdict.action) == ("fallback", outputs[ACTION].values)
        assert "the filter raised" in verdict.sentence
        assert (verdict.predicted, verdict.model, verdict.coverage, verdict.stands) == ((), "", -1.0, 0.0)
    node.forget("r")
    assert node.rescue("r", state, "x")[ACTION].values == (0.0, 0.0)


def test_after_a_failure_the_margin_goes_on_and_all_else_begins_anew() -> None:
    node = SafetyFilterNode(CAR, SETTINGS)
    asked(node, state_at(0), latent_at(state_at(0)))
    before = memory_of(node)
    node.rescue("r", state_at(1), "x")
    asked(node, state_at(2), latent_at(state_at(2)))
    assert memory_of(node) is not before
    assert memory_of(node).margin is before.margin


def test_a_shorter_period_is_another_model_over_that_period_with_the_same_margin() -> None:
    node = SafetyFilterNode(CAR, SETTINGS)
    asked(node, state_at(0), latent_at(state_at(0)))
    before = memory_of(node)
    state = state_at(1, period=0.025)
    verdict = asked(node, state, latent_at(state))
    after = memory_of(node)
    assert after is not before
    assert (after.model.period, after.margin) == (0.025, before.margin)
    wanted, _ = CAR.held(np.array(state.values), np.array(verdict.action), (), CAR.latent, 1, period=0.025)
    np.testing.assert_allclose(verdict.predicted[0], wanted[0], atol=1e-12)
    asked(node, replace(state, tick=2), latent_at(state))
    assert memory_of(node) is after


def test_the_newest_state_and_model_are_told_until_the_robot_leaves() -> None:
    node = SafetyFilterNode(CAR, SETTINGS)
    assert node.newest("r") is None
    state = state_at(0)
    asked(node, state, latent_at(state))
    assert node.newest("r") == state
    assert node.model_of("r") == fingerprint(CAR)
    node.leave("r")
    assert node.newest("r") is None


def test_who_stands_though_something_is_wished_is_told_so() -> None:
    node = SafetyFilterNode(CAR, SETTINGS)
    sentences = []
    for tick in range(140):
        state = state_at(tick, (0.0, 0.0, 0.0, 0.0), obstacles=((0.85, 0.0, 0.3),))
        verdict = asked(node, state, latent_at(state))
        sentences.append(verdict.sentence)
        if tick < 80:
            assert verdict.standstill == ""
    assert verdict.stands == pytest.approx(6.95, abs=0.11)
    assert verdict.standstill
    assert f"The robot has stood for {verdict.stands:.1f} s. {verdict.standstill}." in sentences[-1]
    assert "has stood" not in sentences[20]
