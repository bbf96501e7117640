"""What takes long the first time is done before a robot drives, and changes nothing of what is decided."""

from __future__ import annotations

from typing import Any

import pytest
from tests.safety.node_steps import CAR, SETTINGS, asked, latent_at, memory_of, stamp, state_at

from safedpa.bus import LATENT, WISH, WishMessage
from safedpa.dynamics import PhysicsModel
from safedpa.safety import Status, Verdict
from safedpa.safety.node import SafetyFilterNode
from safedpa.safety.safety_filter import SafetyFilter

OBSTACLES: dict[str, Any] = {"obstacles": ((1.0, 0.2, 0.2),)}


@pytest.fixture
def verdicts(monkeypatch: pytest.MonkeyPatch) -> list[Verdict]:
    """What every filter says from now on."""
    said: list[Verdict] = []
    decide = SafetyFilter.decide

    def noted(self: SafetyFilter, *given: Any, **known: Any) -> Verdict:
        said.append(decide(self, *given, **known))
        return said[-1]

    monkeypatch.setattr(SafetyFilter, "decide", noted)
    return said


def step(node: SafetyFilterNode, tick: int, **changed: Any) -> str:
    state = state_at(tick, **{**OBSTACLES, "period": 0.005, **changed})
    return asked(node, state, latent_at(state)).status


def test_all_that_a_decision_may_need_is_gone_through_once(verdicts: list[Verdict]) -> None:
    node = SafetyFilterNode(CAR, SETTINGS)
    told = [step(node, tick) for tick in range(3)]
    assert told[0] == told[1] == told[2] != "relaxed"
    assert [verdict.status is Status.relaxed for verdict in verdicts] == [False, True, False, False]
    assert memory_of(node).model.straight(0.005) is not None, "else it would be written down while the robot drives"


@pytest.mark.parametrize(
    ("period", "rehearsed"),
    [(0.05, [False, True, False, *[False] * 4]), (0.005, [False, True, False, True, *[False] * 4])],
)
def test_robots_of_one_model_rehearse_once(verdicts: list[Verdict], period: float, rehearsed: list[bool]) -> None:
    """Two hundred that come at once would else wait for one another; over another period each has its own, once."""
    node = SafetyFilterNode(CAR, SETTINGS)
    for tick in range(3):
        for robot in ("r", "s"):
            state = state_at(tick, period=period, **OBSTACLES)
            inputs = {LATENT: latent_at(state), WISH: WishMessage(**stamp(state), values=(1.0, 0.0), controller="test")}
            node.step(robot, state, inputs)
            node.afterwards(robot)
    assert [verdict.status is Status.relaxed for verdict in verdicts] == rehearsed


def test_a_rehearsal_that_fails_costs_no_verdict_and_is_not_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    tried: list[object] = []

    def fails(model: object) -> None:
        tried.append(model)
        raise RuntimeError("cannot be written down")

    monkeypatch.setattr(PhysicsModel, "write_straight", fails)
    node = SafetyFilterNode(CAR, SETTINGS)
    assert [step(node, tick) for tick in range(3)] == ["passed"] * 3
    assert len(tried) == 1


def test_nothing_is_rehearsed_where_nothing_can_be_decided(verdicts: list[Verdict]) -> None:
    node = SafetyFilterNode(CAR, SETTINGS)
    assert step(node, 0, values=(0.0, 0.0, 0.0)) == "fallback", "a state of another size"
    assert len(verdicts) == 1
    step(node, 1)
    assert [verdict.status is Status.relaxed for verdict in verdicts] == [False, False, True]


def test_what_is_decided_afterwards_is_the_same_to_the_last_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    found = []
    for rehearsed in (False, True):
        node = SafetyFilterNode(CAR, SETTINGS)
        with monkeypatch.context() as patch:
            if not rehearsed:
                patch.setattr("safedpa.safety.node._rehearse", lambda *_: None)
            step(node, 0)
        state = state_at(1, period=0.005, **OBSTACLES)
        verdict = asked(node, state, latent_at(state))
        found.append((verdict.status, verdict.action, verdict.h_next, verdict.margin, verdict.predicted))
    assert found[0] == found[1]
