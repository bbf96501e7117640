"""Lines and documents of a replay and of a what-if, for services and decisions that are made up."""

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
from tests import messages

from safedpa.bus import StateMessage, VerdictMessage
from safedpa.records import Finding
from safedpa.replay.replay import Difference, Replay, ServiceReplay, UnknownStateSpan
from safedpa.replay.report import document_of, lines_of, what_if_document, what_if_lines
from safedpa.replay.tape import RecordedMessage, RobotTape, TickGap
from safedpa.replay.what_if import DecisionPair, summary_of


def state_of(tick: int) -> StateMessage:
    return messages.state_of(**messages.stamp(tick, 0.5, epoch=3), period=0.5)


def verdict_of(tick: int, **changes: Any) -> VerdictMessage:
    what = {"status": "passed", "action": (1.0, 0.0), "nominal": (1.0, 0.0), "h_now": 0.5, "h_next": 0.5}
    return messages.verdict_of(**{**messages.stamp(tick, 0.5, epoch=3), **what, **changes})


def difference_at(tick: int) -> Difference:
    return Difference(3, tick, 0.5 * tick, "latent", "values", 1.0, 2.0, exact_only=False)


SERVICES = ("adaptation", "policy", "safety_filter")


def replay_of(which: int, *, differing: int = 0, rounded: int = 0, compared: int = 5) -> Replay:
    """Three services; the one with number ``which`` was compared, with so many differences."""
    parts = [ServiceReplay(name) for name in SERVICES]
    counts = {"latent": compared} if compared else {}
    found = [difference_at(tick) for tick in range(differing)]
    parts[which] = ServiceReplay(SERVICES[which], counts, counts, found, rounded)
    return Replay(parts)


def tape_of(findings: tuple[str, ...] = ()) -> RobotTape:
    states = {(3, tick): state_of(tick) for tick in (4, 5, 6)}
    return RobotTape("r1", (Path("a.mcap"),), states, findings=[Finding(kind, f"about {kind}") for kind in findings])


@pytest.mark.parametrize("which", range(3))
@pytest.mark.parametrize(
    ("parts", "last", "agrees", "exact"),
    [
        ({}, "identical", True, True),
        ({"rounded": 4}, "equal within the tolerance: 4 fields", True, False),
        ({"differing": 1}, "DIFFERENT", False, False),
        ({"differing": 1, "rounded": 4}, "DIFFERENT", False, False),
        ({"compared": 0}, "nothing was compared", True, True),
    ],
)
def test_the_last_line_is_the_verdict_over_all_services(which, parts, last, agrees, exact):
    found = replay_of(which, **parts)
    assert (found.agrees, found.exact) == (agrees, exact)
    assert list(lines_of(tape_of(), found, [], []))[-1].startswith(last)


@pytest.mark.parametrize("which", range(3))
@pytest.mark.parametrize(("agrees_from", "again_from"), [(None, None), (9, None), (None, 9)])
def test_a_replay_is_not_confirmed_while_a_memory_is_unknown_at_the_end(which, agrees_from, again_from):
    found = replay_of(0)
    found.services[which].spans = [
        UnknownStateSpan("a gap", 3, 1, 0.5, agrees_from=2),
        UnknownStateSpan("another", 3, 5, 2.5, agrees_from, again_from, steps=2),
    ]  # fmt: skip
    settled = agrees_from is not None or again_from is not None
    assert (found.unsettled is None, found.agrees) == (settled, settled)
    lines = list(lines_of(tape_of(), found, [], []))
    assert lines[-1].startswith("identical" if settled else "not confirmed")
    assert len([line for line in lines if "memory not known" in line]) == 2


@pytest.mark.parametrize(("count", "shown", "more"), [(1, 1, ""), (10, 10, ""), (11, 10, "1 more fields")])
def test_the_ten_earliest_differences_of_all_services_are_listed(count: int, shown: int, more: str) -> None:
    found = replay_of(0)
    for number in reversed(range(count)):
        found.services[number % 3].differing.append(difference_at(number))
    lines = list(lines_of(tape_of(), found, [], []))
    assert [int(line.split()[1]) for line in lines if line.startswith("  tick ")] == list(range(shown))
    assert any(more in line for line in lines if line.startswith("  ...")) is bool(more)


def test_findings_gaps_and_assumptions_are_in_lines_and_document() -> None:
    tape, gaps = tape_of(("first", "last")), [TickGap("state", 3, 1, 5, 3), TickGap("policy", 3, 6, 8, 1)]
    assumed = ["a setup", "a model"]
    lines = list(lines_of(tape, replay_of(1), gaps, assumed))
    sentences = [f"not recorded: {gap.sentence}" for gap in gaps]
    for part in ("first: about first", "last: about last", "assumed: a setup", "assumed: a model", *sentences):
        assert f"  {part}" in lines
    document = document_of(tape, replay_of(1), gaps, assumed)
    assert [finding["kind"] for finding in document["findings"]] == ["first", "last"]
    assert document["not_recorded"] == [asdict(gap) for gap in gaps]
    assert document["assumed"] == assumed


def test_the_counts_of_a_drive_leave_out_an_unknown_h_and_count_the_watchdog() -> None:
    tape = tape_of()
    tape.states[3, 5] = replace(state_of(5), applied_by="watchdog")
    unknown = verdict_of(4, status="fallback", h_now=0.0, h_next=0.0)
    for tick, verdict in enumerate((unknown, verdict_of(5), verdict_of(6, h_now=0.25, status="fallback")), 4):
        tape.computed["safety_filter"].append(RecordedMessage(tick, verdict))
    document = document_of(tape, replay_of(0), [], [])
    assert document["verdicts"] == {"fallback": 2, "passed": 1}
    assert (document["least_h_now"], document["braked_by_watchdog"]) == (0.25, 1)
    lines = list(lines_of(tape, replay_of(0), [], []))
    assert "  watchdog       1 of 3 periods without an action in time" in lines


def test_the_document_of_a_replay_is_complete() -> None:
    """Three states at 2, 2.5 and 3 s; one service of three differs, and two fields in their last digits."""
    assert document_of(tape_of(), replay_of(1, differing=1, rounded=2), [], []) == {
        "format": 1, "robot": "r1", "files": ["a.mcap"], "states": 3, "seconds": [2.0, 3.0], "agrees": False,
        "exact": False, "assumed": [], "findings": [], "not_recorded": [], "verdicts": {}, "least_h_now": None,
        "braked_by_watchdog": 0,
        "services": [
            {"service": name, "compared": {"latent": 5} if own else {}, "identical": {"latent": 5} if own else {},
             "differing": int(own), "rounded": 2 * own, "spans": [], "lost": 0}
            for name, own in zip(SERVICES, (False, True, False), strict=True)
        ],
        "differences": [
            {"epoch": 3, "tick": 0, "robot_time": 0.0, "topic": "latent", "field": "values", "recorded": 1.0,
             "replayed": 2.0, "exact_only": False}
        ],
    }  # fmt: skip


@pytest.mark.parametrize(("count", "listed"), [(100, 100), (103, 100)])
def test_the_document_counts_all_differences_and_lists_a_hundred_of_each_service(count: int, listed: int) -> None:
    found = replay_of(0, differing=count)
    found.services[2].differing.append(difference_at(900))
    document = document_of(tape_of(), found, [], [])
    assert [part["differing"] for part in document["services"]] == [count, 0, 1]
    assert [item["tick"] for item in document["differences"]] == [*range(listed), 900]


def test_the_line_of_a_service_counts_every_topic() -> None:
    part = ServiceReplay("safety_filter", {"action": 7, "verdict": 5}, {"action": 6, "verdict": 4}, lost=3)
    lines = list(lines_of(tape_of(), Replay([part, ServiceReplay("policy")]), [], []))
    assert [line.split(maxsplit=1) for line in lines if line.startswith(("  safety", "  policy"))] == [
        ["safety_filter", "action 6 of 7 identical, verdict 4 of 5 identical; 3 recomputed"],
        ["policy", "nothing to compare"],
    ]


USUAL = (0.9, 0.8, 0.7, 0.6)


def decided(h: list[tuple[float, float, float, float]], **changes: Any) -> list[DecisionPair]:
    """By tick: h now and next as recorded, and of the other filter."""
    return [
        DecisionPair(
            state_of(tick),
            verdict_of(tick, h_now=then_now, h_next=then_next),
            verdict_of(tick, h_now=now_now, h_next=now_next, **changes),
        )
        for tick, (then_now, then_next, now_now, now_next) in enumerate(h)
    ]


@pytest.mark.parametrize(
    ("h", "smallest"),
    [
        ([(0.5, 0.4, 0.3, 0.2), USUAL, USUAL], (0.3, 0.4, 0.2)),
        ([USUAL, (0.5, 0.4, 0.3, 0.2), USUAL], (0.3, 0.4, 0.2)),
        ([USUAL, USUAL, (0.5, 0.4, 0.3, 0.2)], (0.3, 0.4, 0.2)),
        # zeros of a filter that could not compute h do not count
        ([(0.0, 0.0, 0.7, 0.6), (0.9, 0.8, 0.0, 0.0), (0.9, 0.8, 0.7, 0.0)], (0.7, 0.8, 0.0)),
        ([(0.0, 0.0, 0.0, 0.0)], (0.0, 0.0, 0.0)),
    ],
)
def test_the_smallest_h_is_that_of_any_tick(h, smallest):
    summary = summary_of(decided(h))
    assert (summary.smallest_h_now, summary.smallest_h_then, summary.smallest_h_other) == smallest


@pytest.mark.parametrize("at", range(3))
@pytest.mark.parametrize(
    ("changes", "differs", "distance"),
    [
        ({"status": "corrected"}, True, 0.0),
        ({"action": (1.0, 0.25)}, True, 0.25),
        ({"action": (1.0, -1e-7)}, False, 1e-7),
        ({"slack": 1.0}, False, 0.0),
    ],
)
def test_a_different_decision_in_any_tick_is_counted_and_listed(at, changes, differs, distance):
    decisions = decided([USUAL] * 3)
    decisions[at] = replace(decisions[at], now=replace(decisions[at].now, **changes))
    summary = summary_of(decisions)
    assert (summary.ticks, summary.differing) == (3, differs)
    assert summary.largest_distance == pytest.approx(distance)
    assert summary.largest_distance_at == (0.5 * at if distance else 0.0)
    assert summary.status_then == {"passed": 3}
    assert summary.status_now == ({"passed": 2, "corrected": 1} if "status" in changes else {"passed": 3})
    document = what_if_document(summary, decisions, "eta 0.1")
    assert [item["tick"] for item in document["differing"]] == [at] * differs
    lines = list(what_if_lines(summary, decisions, "eta 0.1"))
    assert len([line for line in lines if line.startswith("    tick ")]) == differs


def test_the_document_of_a_what_if_is_complete() -> None:
    decisions = decided([USUAL, (0.5, 0.4, 0.3, 0.2)])
    other = replace(decisions[1].now, status="relaxed", action=(0.5, 0.25), margin=0.125, slack=2.0)
    decisions[1] = replace(decisions[1], now=other)
    summary = summary_of(decisions)
    assert what_if_document(summary, decisions, "eta 0.1") == {
        "changed": "eta 0.1",
        "states": "recorded (open loop)",
        "summary": asdict(summary),
        "differing": [
            {
                "epoch": 3, "tick": 1, "robot_time": 0.5,
                "then": {"status": "passed", "action": [1.0, 0.0], "h_now": 0.5, "h_next": 0.4, "margin": 0.0,
                         "slack": 0.0},
                "now": {"status": "relaxed", "action": [0.5, 0.25], "h_now": 0.3, "h_next": 0.2, "margin": 0.125,
                        "slack": 2.0},
            }
        ],
    }  # fmt: skip


@pytest.mark.parametrize("at", range(3))
def test_each_status_is_counted_then_and_now(at: int) -> None:
    decisions = decided([USUAL] * 3, status="relaxed")
    decisions[at] = replace(decisions[at], then=replace(decisions[at].then, status="corrected"))
    lines = what_if_lines(summary_of(decisions), decisions, "eta 0.1")
    assert [line.split() for line in lines if " then  " in line] == [
        ["corrected", "then", "1", "now", "0"], ["passed", "then", "2", "now", "0"],
        ["relaxed", "then", "0", "now", "3"],
    ]  # fmt: skip


@pytest.mark.parametrize(("count", "more"), [(10, False), (11, True)])
def test_ten_decisions_are_listed_with_the_number_of_the_others(count: int, more: bool) -> None:
    decisions = decided([USUAL] * count, status="corrected")
    lines = list(what_if_lines(summary_of(decisions), decisions, "eta 0.1"))
    assert len([line for line in lines if line.startswith("    tick ")]) == 10
    assert any("... and 1 more" in line for line in lines) is more
