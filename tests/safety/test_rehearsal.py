"""What takes long the first time is done before a robot drives, and changes no decision."""

from __future__ import annotations

from typing import Any

import pytest
from tests.safety.node_steps import CAR, SETTINGS, latent_at, stamp, state_at

from safedpa.bus import LATENT, VERDICT, WISH, VerdictMessage, WishMessage
from safedpa.dynamics import PhysicsModel
from safedpa.safety import SafetyFilter, Status, Verdict
from safedpa.safety.node import SafetyFilterNode


@pytest.fixture
def verdicts(monkeypatch: pytest.MonkeyPatch) -> list[Verdict]:
    """What every filter decides from now on."""
    said: list[Verdict] = []
    decide = SafetyFilter.decide

    def noted(self: SafetyFilter, *given: Any, **known: Any) -> Verdict:
        said.append(decide(self, *given, **known))
        return said[-1]

    monkeypatch.setattr(SafetyFilter, "decide", noted)
    return said


def step(node: SafetyFilterNode, tick: int, robot: str = "r", **changed: Any) -> VerdictMessage:
    state = state_at(tick, **{"obstacles": ((1.0, 0.2, 0.2),), "period": 0.005, **changed})
    wish = WishMessage(**stamp(state), values=(1.0, 0.0), controller="test")
    node.step(robot, state, {LATENT: latent_at(state), WISH: wish})
    verdict = node.afterwards(robot)[VERDICT]
    assert isinstance(verdict, VerdictMessage)
    return verdict


@pytest.mark.parametrize(
    ("period", "relaxed"),
    [(0.05, [False, True, False, *[False] * 4]), (0.005, [False, True, False, True, *[False] * 4])],
)
def test_robots_of_one_model_rehearse_the_search_for_the_least_violation_once(
    verdicts: list[Verdict], period: float, relaxed: list[bool]
) -> None:
    """Two hundred that come at once would otherwise wait for one another; over another period each rehearses once."""
    node = SafetyFilterNode(CAR, SETTINGS)
    for tick in range(3):
        for robot in ("r", "s"):
            assert step(node, tick, robot, period=period).status != "relaxed"
    assert [verdict.status is Status.relaxed for verdict in verdicts] == relaxed


def test_a_rehearsal_that_fails_costs_no_verdict_and_is_not_repeated(monkeypatch: pytest.MonkeyPatch) -> None:
    tried: list[object] = []

    def fails(model: object) -> None:
        tried.append(model)
        raise RuntimeError("cannot be written down")

    monkeypatch.setattr(PhysicsModel, "write_straight", fails)
    node = SafetyFilterNode(CAR, SETTINGS)
    assert [step(node, tick).status for tick in range(3)] == ["passed"] * 3
    assert len(tried) == 1


def test_nothing_is_rehearsed_where_nothing_can_be_decided(verdicts: list[Verdict]) -> None:
    node = SafetyFilterNode(CAR, SETTINGS)
    assert step(node, 0, values=(0.0, 0.0, 0.0)).status == "fallback", "a state of another size"
    assert len(verdicts) == 1
    step(node, 1)
    assert [verdict.status is Status.relaxed for verdict in verdicts] == [False, False, True]


def test_a_rehearsal_changes_no_later_decision() -> None:
    """At the model's own period one robot rehearses for all: the second robot's filter has not."""
    node = SafetyFilterNode(CAR, SETTINGS)
    for tick in range(3):
        one, other = (step(node, tick, robot, period=0.05) for robot in ("r", "s"))
        for name in ("status", "action", "slack", "h_next", "margin", "predicted", "sentence"):
            assert getattr(one, name) == getattr(other, name)
