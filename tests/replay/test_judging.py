"""What a replay counts step by step: what is missing, what was rounded, what a gap leaves open."""

from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from tests.messages import verdict_of

from safedpa.bus import ACTION, LATENT, VERDICT, ActionMessage, LatentMessage, VerdictMessage
from safedpa.bus.messages.service_info import setup_message
from safedpa.replay.driver import Driver, ReplayedStep
from safedpa.replay.replay import Difference, Replay, ServiceReplay, replay
from safedpa.replay.tape import RecordedMessage, RobotTape

FIELDS = {topic.message: frozenset(item.name for item in fields(topic.message)) for topic in (LATENT, VERDICT, ACTION)}
EVERYWHERE = (float("-inf"), float("inf"))
Judged = Callable[..., ServiceReplay]


def stamp(tick: int) -> dict[str, Any]:
    return {"epoch": 3, "tick": tick, "robot_time": 0.05 * tick, "publish_time": 7.0}


def latent(tick: int, value: float = 0.1) -> LatentMessage:
    return LatentMessage(**stamp(tick), model="m", values=(value,), deviations=(0.1,))


def verdict(tick: int) -> VerdictMessage:
    return verdict_of("passed", **stamp(tick), sentence="The nominal action is safe.", action=(1.0, 0.0), margin=0.03)


def action(tick: int, steer: float = 0.0) -> ActionMessage:
    return ActionMessage(**stamp(tick), values=(1.0, steer))


def step(tick: int, recorded: Any, outputs: dict[Any, Any], unknown: str = "", again: bool = False) -> ReplayedStep:
    state: Any = SimpleNamespace(epoch=3, tick=tick, robot_time=0.05 * tick)
    return ReplayedStep(state, recorded, outputs, unknown, again)


@pytest.fixture
def judged(monkeypatch: pytest.MonkeyPatch) -> Judged:
    """A replay of steps that are given, in place of those of the service's node."""

    def of(
        service: str,
        steps: list[ReplayedStep],
        window: tuple[float, float] = EVERYWHERE,
        actions: dict[Any, Any] | None = None,
    ) -> ServiceReplay:
        tape = RobotTape("r1", (Path("a.mcap"),), actions=actions or {}, fields=FIELDS)
        tape.setups[service] = [(0, setup_message(service, {}))]
        tape.computed[service] = [RecordedMessage(0, step.recorded) for step in steps if step.recorded is not None]
        monkeypatch.setattr(Driver, "run", lambda _: iter(steps))
        (found,) = replay(tape, window).services
        return found

    return of


def test_a_message_that_does_not_come_out_again_is_a_difference(judged: Judged) -> None:
    """The node now refuses the state."""
    found = judged("adaptation", [step(4, latent(4), {LATENT: latent(4)}), step(5, latent(5), {})])
    assert found.differing == [Difference(3, 5, 0.25, "latent", "message", "sent", "none", exact_only=False)]
    assert (found.compared, found.identical) == ({"latent": 2}, {"latent": 1})
    assert not Replay([found]).agrees


def test_the_action_of_a_verdict_is_compared_too(judged: Judged) -> None:
    known = {(3, 9): [action(9)]}
    both = {VERDICT: verdict(9), ACTION: action(9)}
    assert judged("safety_filter", [step(9, verdict(9), both)], actions=known).differing == []
    (missing,) = judged("safety_filter", [step(9, verdict(9), {VERDICT: verdict(9)})], actions=known).differing
    assert (missing.topic, missing.tick, missing.field) == ("action", 9, "message")
    other = {VERDICT: verdict(9), ACTION: action(9, 0.2)}
    (steered,) = judged("safety_filter", [step(9, verdict(9), other)], actions=known).differing
    assert (steered.topic, steered.field, steered.recorded, steered.replayed) == (
        "action", "values", (1.0, 0.0), (1.0, 0.2),
    )  # fmt: skip


def test_of_two_answers_to_a_tick_the_action_of_the_verdict_is_compared(judged: Judged) -> None:
    known = {(3, 9): [action(9, 0.3), action(9)]}
    both = {VERDICT: verdict(9), ACTION: action(9)}
    assert judged("safety_filter", [step(9, verdict(9), both)], actions=known).differing == []


@pytest.mark.parametrize(
    "field", [name for name in sorted(FIELDS[VerdictMessage]) if name not in ("version", "microseconds")]
)
def test_every_field_of_a_decision_is_compared(judged: Judged, field: str) -> None:
    """All but when, how long and from what."""
    value = getattr(verdict(9), field)
    changed: Any = value + 1 if isinstance(value, int | float) else ("?",) if isinstance(value, tuple) else f"{value}?"
    out = replace(verdict(9), **{field: changed})
    found = judged("safety_filter", [step(9, verdict(9), {VERDICT: out})])
    left_out = {"publish_time", "step", "consumed", "skipped"}
    assert [item.field for item in found.differing] == ([] if field in left_out else [field])


def test_another_last_digit_is_counted_and_is_no_difference(judged: Judged) -> None:
    found = judged("adaptation", [step(4, latent(4), {LATENT: latent(4, 0.1 + 1e-12)})])
    assert (found.differing, found.rounded, found.identical) == ([], 1, {"latent": 0})
    assert Replay([found]).agrees
    assert not Replay([found]).exact
    assert not Replay([ServiceReplay("policy"), found]).exact
    assert not Replay([found, ServiceReplay("policy")]).exact


@pytest.mark.parametrize(("agreeing", "known_again"), [(19, False), (20, True), (30, True)])
def test_a_memory_counts_as_known_again_after_twenty_outputs_that_agree(judged, agreeing, known_again):
    """Differences behind a gap may stem from the gap, and a few outputs may agree by chance."""
    steps = [
        step(0, latent(0), {LATENT: latent(0)}),
        step(1, latent(1), {LATENT: latent(1, 0.5)}, "a state is missing"),
    ]
    steps += [step(tick, latent(tick), {LATENT: latent(tick)}) for tick in range(2, 2 + agreeing)]
    found = judged("adaptation", steps)
    (span,) = found.spans
    assert (span.reason, span.tick, span.steps) == ("a state is missing", 1, 1 if known_again else 1 + agreeing)
    assert span.agrees_from == (2 if known_again else None)
    assert found.compared == {"latent": 1 + agreeing if known_again else 1}
    assert found.differing == []
    assert (Replay([found]).unsettled is None) == known_again
    assert Replay([found]).agrees == known_again


def test_a_difference_restarts_the_count_of_agreeing_outputs(judged: Judged) -> None:
    steps = [step(0, latent(0), {LATENT: latent(0, 0.5)}, "unknown")]
    steps += [step(tick, latent(tick), {LATENT: latent(tick, 0.5 if tick == 15 else 0.1)}) for tick in range(1, 40)]
    (span,) = judged("adaptation", steps).spans
    assert (span.agrees_from, span.steps) == (16, 16)


def test_a_memory_that_is_reset_is_known_again(judged: Judged) -> None:
    steps = [
        step(0, latent(0), {LATENT: latent(0, 0.5)}, "unknown"),
        step(1, latent(1), {LATENT: latent(1)}, again=True),
    ]
    found = judged("adaptation", [*steps, step(2, latent(2), {LATENT: latent(2, 0.5)})])
    assert [(span.agrees_from, span.again_from) for span in found.spans] == [(None, 1)]
    assert [item.tick for item in found.differing] == [2]
    assert Replay([found]).unsettled is None


def test_the_window_is_counted_with_both_ends_and_lost_outputs_are_counted(judged: Judged) -> None:
    steps = [step(tick, latent(tick) if tick != 7 else None, {LATENT: latent(tick)}) for tick in range(20)]
    found = judged("adaptation", steps, (0.25, 0.5))
    assert found.compared == {"latent": 5}, "ticks 5 to 10 without tick 7"
    assert found.lost == 1
