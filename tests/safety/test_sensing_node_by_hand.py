"""A robot that names sources: what the filter says of what they see, and nothing of it once the robot names none."""

from __future__ import annotations

from math import cos, pi, sin
from typing import Any

import pytest
from tests.safety.node_steps import CAR, SETTINGS, latent_at, stamp, state_at

from safedpa.bus import LATENT, SURROUNDINGS, VERDICT, WISH, StateMessage, SurroundingsMessage, VerdictMessage
from safedpa.bus import WishMessage as Wish
from safedpa.safety.node import SafetyFilterNode

STANDS = (0.0, 0.0, 0.0, 0.0)
BESIDE = (0.75, 0.0, 0.25, 0.0, 0.0, 1.5)
"""A mover half a metre before the car that may come at 1.5 m/s."""


def verdict_at(node: SafetyFilterNode, state: StateMessage, **seen: Any) -> VerdictMessage:
    inputs: dict[Any, Any] = {
        LATENT: latent_at(state),
        WISH: Wish(**stamp(state), values=(0.2, 0.0), controller="test"),
        SURROUNDINGS: SurroundingsMessage(
            **stamp(state), **{"points": (), "movers": (), "hidden": (), "ages": (0.05,), **seen}
        ),
    }
    node.step("r", state, inputs)
    verdict = node.afterwards("r")[VERDICT]
    assert isinstance(verdict, VerdictMessage)
    return verdict


def sensing(**changed: Any) -> StateMessage:
    return state_at(0, STANDS, **{"sources": ("laser",), "obstacles": (), **changed})


def ring(count: int) -> tuple[tuple[float, ...], ...]:
    """Points (x, y, radius) in m on a circle around the car, near enough to matter and far enough to be safe."""
    angles = [2.0 * pi * number / count for number in range(count)]
    return tuple((0.7 * cos(angle), 0.7 * sin(angle), 0.01) for angle in angles)


def test_a_robot_that_started_anew_without_sources_yields_to_nobody_whom_it_saw_before() -> None:
    node = SafetyFilterNode(CAR, SETTINGS)
    seen = verdict_at(node, sensing(), movers=(BESIDE,))
    assert (seen.status, "mover 0" in seen.sentence) == ("stopped", True)
    anew = verdict_at(node, state_at(0, STANDS, epoch=2, obstacles=()))
    assert (anew.status, anew.action) == ("passed", (0.2, 0.0))


@pytest.mark.parametrize(("points", "said"), [(64, ""), (65, "Of 65 points near it"), (70, "Of 70 points near it")])
def test_what_was_not_looked_at_is_said_in_the_tick_of_which_it_is_true(points: int, said: str) -> None:
    """Sixty-four of them are looked at."""
    node = SafetyFilterNode(CAR, SETTINGS)
    seen = verdict_at(node, sensing(), points=ring(points))
    assert ("near it, those with the least h were looked at." in seen.sentence) is bool(said)
    assert said in seen.sentence
    assert seen.sentence == seen.sentence.strip()
    anew = verdict_at(node, state_at(0, STANDS, epoch=2, obstacles=()))
    assert "near it" not in anew.sentence
    assert anew.status == "passed"


@pytest.mark.parametrize("known", [True, False])
def test_a_robot_with_sources_is_rescued_as_one_without(known: bool) -> None:
    """Whether it was filtered before or not, what is left is an action and a verdict that says so."""
    node, state = SafetyFilterNode(CAR, SETTINGS), sensing()
    if known:
        verdict_at(node, state, points=ring(70))
    verdict = node.rescue("r", state, "the step raised")[VERDICT]
    assert isinstance(verdict, VerdictMessage)
    assert verdict.status == "fallback"
    assert "the step raised" in verdict.sentence
    assert "near it" not in verdict.sentence
