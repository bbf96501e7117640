"""What the lines and documents of a replay say, of services and decisions that are made up: first, last and in between.

Each item that is to be counted or told stands once at the first, once at another place: nothing is left out at either.
"""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest

from safedpa.bus import ACTION, ActionMessage, LatentMessage, StateMessage, VerdictMessage
from safedpa.errors import RunError
from safedpa.records import Finding
from safedpa.replay.comparison import Difference, differences
from safedpa.replay.gaps import TickGap
from safedpa.replay.replay import Replay, ServiceReplay, Span
from safedpa.replay.report import document_of, lines_of, what_if_document, what_if_lines
from safedpa.replay.ros2_bag import _kind_of
from safedpa.replay.tape import RobotTape
from safedpa.replay.what_if import DecisionTwice, _Hypothetical, summary_of
from safedpa.robot import robots


def stamp(tick: int) -> dict[str, Any]:
    return {"epoch": 3, "tick": tick, "robot_time": 0.5 * tick, "publish_time": 7.0}


def state_of(tick: int, **changes: Any) -> StateMessage:
    what = {"values": (0.0, 0.0, 0.0, 1.0), "applied": (1.0, 0.0), "applied_by": "filter", "period": 0.5}
    what |= {"lockstep": True, "goal": (), "obstacles": (), "field": (-4.0, 4.0, -4.0, 4.0), "footprint": ()}
    return StateMessage(**{**stamp(tick), **what, **changes})


def verdict_of(tick: int, **changes: Any) -> VerdictMessage:
    what: dict[str, Any] = {"status": "passed", "sentence": "", "action": (1.0, 0.0), "wish": (1.0, 0.0), "slack": 0.0}
    what |= {"active": (), "h_now": 0.5, "h_next": 0.5, "margin": 0.0, "solver": "", "microseconds": 1.0}
    return VerdictMessage(**{**stamp(tick), **what, **changes})


def difference_at(tick: int, field: str = "values") -> Difference:
    return Difference(3, tick, 0.5 * tick, "latent", field, 1.0, 2.0, exact_only=False)


SERVICES = ("adaptation", "policy", "safety_filter")


def replay_of(which: int, *, differing: int = 0, rounded: int = 0, compared: int = 5) -> Replay:
    """Three services, of which one has so many of these; the others agree, as far as they were compared."""
    parts = []
    for number, name in enumerate(SERVICES):
        own = number == which
        found = [difference_at(tick) for tick in range(differing)] if own else []
        counts = {"latent": compared} if own and compared else {}
        parts.append(ServiceReplay(name, counts, counts, found, rounded if own else 0))
    return Replay(parts)


def tape_of(findings: tuple[str, ...] = ()) -> RobotTape:
    states = {(3, tick): state_of(tick) for tick in (4, 5, 6)}
    return RobotTape("r1", (Path("a.mcap"),), states, findings=[Finding(kind, f"about {kind}") for kind in findings])


@pytest.mark.parametrize("which", range(3))
@pytest.mark.parametrize(
    ("parts", "told", "agrees", "exact"),
    [
        ({}, "identical", True, True),
        ({"rounded": 4}, "equal within the tolerance: 4 fields", True, False),
        ({"differing": 1}, "DIFFERENT", False, False),
        ({"differing": 1, "rounded": 4}, "DIFFERENT", False, False),
        ({"compared": 0}, "nothing was compared", True, True),
    ],
)
def test_whichever_service_it_is_the_last_line_says_whether_all_came_out_as_recorded(
    which: int, parts: dict[str, int], told: str, agrees: bool, exact: bool
) -> None:
    found = replay_of(which, **parts)
    assert (found.agrees, found.exact) == (agrees, exact)
    assert list(lines_of(tape_of(), found, [], []))[-1].startswith(told)


@pytest.mark.parametrize("which", range(3))
@pytest.mark.parametrize(("agrees_from", "anew_from"), [(None, None), (9, None), (None, 9)])
def test_a_memory_of_any_service_that_is_unknown_to_the_end_confirms_nothing(
    which: int, agrees_from: int | None, anew_from: int | None
) -> None:
    found = replay_of(0)
    found.services[which].spans = [
        Span("a gap", 3, 1, 0.5, agrees_from=2), Span("another", 3, 5, 2.5, agrees_from, anew_from, steps=2),
    ]  # fmt: skip
    open_to_the_end = agrees_from is None and anew_from is None
    assert (found.unsettled is None, found.agrees) == (not open_to_the_end, not open_to_the_end)
    said = list(lines_of(tape_of(), found, [], []))
    assert said[-1].startswith("not confirmed" if open_to_the_end else "identical")
    assert len([line for line in said if "memory not known" in line]) == 2


@pytest.mark.parametrize(("count", "shown", "more"), [(1, 1, ""), (10, 10, ""), (11, 10, "1 more fields")])
def test_the_first_ten_differences_of_all_services_are_told_in_the_order_of_time(
    count: int, shown: int, more: str
) -> None:
    found = replay_of(0, differing=0)
    for number in reversed(range(count)):
        found.services[number % 3].differing.append(difference_at(number))
    said = list(lines_of(tape_of(), found, [], []))
    ticks = [int(line.split()[1]) for line in said if line.startswith("  tick ")]
    assert ticks == list(range(shown))
    assert any(more in line for line in said if line.startswith("  ...")) is bool(more)


def test_findings_gaps_and_assumptions_are_all_told_in_lines_and_documents() -> None:
    tape, gaps = tape_of(("first", "last")), [TickGap("state", 3, 1, 5, 3), TickGap("policy", 3, 6, 8, 1)]
    assumed = ["a setup", "a model"]
    said = list(lines_of(tape, replay_of(1), gaps, assumed))
    for told in ("first: about first", "last: about last", "assumed: a setup", "assumed: a model"):
        assert f"  {told}" in said
    assert [line for line in said if "not recorded" in line] == [f"  not recorded: {gap.sentence}" for gap in gaps]
    document = document_of(tape, replay_of(1), gaps, assumed)
    assert [finding["kind"] for finding in document["findings"]] == ["first", "last"]
    assert document["not_recorded"] == [asdict(gap) for gap in gaps]
    assert (document["assumed"], document["files"]) == (assumed, ["a.mcap"])


@pytest.mark.parametrize("which", range(3))
@pytest.mark.parametrize(("count", "told"), [(2, 2), (100, 100), (103, 100)])
def test_the_document_counts_the_differences_of_every_service_and_tells_a_hundred_of_each(
    which: int, count: int, told: int
) -> None:
    found = replay_of(which, differing=count)
    found.services[(which + 1) % 3].differing.append(difference_at(900))
    document = document_of(tape_of(), found, [], [])
    counts = {part["service"]: part["differing"] for part in document["services"]}
    assert counts == {name: count if n == which else int(n == (which + 1) % 3) for n, name in enumerate(SERVICES)}
    ticks = sorted(item["tick"] for item in document["differences"])
    assert ticks == [*range(told), 900]


def test_the_document_of_a_replay_has_each_field_once() -> None:
    """Three states at 2, 2.5 and 3 s; one service of three differs, and one field in its last digits."""
    found = replay_of(1, differing=1, rounded=2)
    document = document_of(tape_of(), found, [], [])
    told = {key: document.pop(key) for key in ("services", "differences")}
    assert document == {
        "format": 1, "robot": "r1", "files": ["a.mcap"], "states": 3, "seconds": [2.0, 3.0], "agrees": False,
        "exact": False, "assumed": [], "findings": [], "not_recorded": [],
    }  # fmt: skip
    assert told["services"][1] == {
        "service": "policy", "compared": {"latent": 5}, "identical": {"latent": 5}, "differing": 1, "rounded": 2,
        "spans": [], "lost": 0,
    }  # fmt: skip
    assert told["differences"] == [
        {"epoch": 3, "tick": 0, "robot_time": 0.0, "topic": "latent", "field": "values", "recorded": 1.0,
         "replayed": 2.0, "exact_only": False}
    ]  # fmt: skip
    alike = document_of(tape_of(), replay_of(1, rounded=2), [], [])
    assert (alike["agrees"], alike["exact"]) == (True, False)


def test_a_line_of_a_service_counts_every_topic() -> None:
    part = ServiceReplay("safety_filter", {"action": 7, "verdict": 5}, {"action": 6, "verdict": 4}, lost=3)
    said = list(lines_of(tape_of(), Replay([part, ServiceReplay("policy")]), [], []))
    assert [line.split(maxsplit=1) for line in said if line.startswith(("  safety", "  policy"))] == [
        ["safety_filter", "action 6 of 7 identical, verdict 4 of 5 identical; 3 made up"],
        ["policy", "nothing to compare"],
    ]


def test_fields_are_compared_where_the_recording_has_them_and_say_what_was_decided() -> None:
    one = LatentMessage(**stamp(1), model="m", values=(0.1,), deviations=(0.2,))
    other = replace(one, publish_time=8.0, model="n", values=(0.3,), deviations=(0.2 + 1e-9,))
    every = frozenset(asdict(one))
    found = {item.field: item.exact_only for item in differences("latent", one, other, every)}
    assert found == {"model": False, "values": False, "deviations": True}
    for left_out in every:
        names = {item.field for item in differences("latent", one, other, every - {left_out})}
        assert names == set(found) - {left_out}


def decided(h: list[tuple[float, float, float, float]], **changes: Any) -> list[DecisionTwice]:
    """By tick: h now and next as recorded, and as the other filter has them."""
    return [
        DecisionTwice(
            state_of(tick),
            verdict_of(tick, h_now=then_now, h_next=then_next),
            verdict_of(tick, h_now=now_now, h_next=now_next, **changes),
        )
        for tick, (then_now, then_next, now_now, now_next) in enumerate(h)
    ]


@pytest.mark.parametrize("at", range(3))
def test_the_least_h_is_that_of_any_tick(at: int) -> None:
    """The smallest of each stands at the same tick, once the first, once the last."""
    values = [(0.9, 0.8, 0.7, 0.6)] * 3
    values[at] = (0.5, 0.4, 0.3, 0.2)
    summary = summary_of(decided(values))
    assert (summary.smallest_h_now, summary.smallest_h_then, summary.smallest_h_other) == (0.3, 0.4, 0.2)


def test_where_a_filter_could_not_compute_h_its_zeros_do_not_count() -> None:
    known = summary_of(decided([(0.0, 0.0, 0.7, 0.6), (0.9, 0.8, 0.0, 0.0), (0.9, 0.8, 0.7, 0.0)]))
    assert (known.smallest_h_now, known.smallest_h_then, known.smallest_h_other) == (0.7, 0.8, 0.0)
    nothing = summary_of(decided([(0.0, 0.0, 0.0, 0.0)]))
    assert nothing.smallest_h_other == 0.0


@pytest.mark.parametrize("at", range(3))
@pytest.mark.parametrize(
    ("changes", "differs"), [({"status": "corrected"}, True), ({"action": (1.0, 0.25)}, True), ({"slack": 1.0}, False)]
)
def test_what_is_decided_otherwise_in_any_tick_is_counted_and_told(
    at: int, changes: dict[str, Any], differs: bool
) -> None:
    decisions = decided([(0.9, 0.8, 0.7, 0.6)] * 3)
    decisions[at] = replace(decisions[at], now=replace(decisions[at].now, **changes))
    summary = summary_of(decisions)
    assert summary.differing == differs
    assert (summary.largest_distance, summary.largest_distance_at) == (
        (0.25, 0.5 * at) if "action" in changes else (0.0, 0.0)
    )
    document = what_if_document(summary, decisions, "eta 0.1")
    assert [item["tick"] for item in document["differing"]] == [at] * differs
    lines = list(what_if_lines(summary, decisions, "eta 0.1"))
    assert len([line for line in lines if line.startswith("    tick ")]) == differs
    status = changes.get("status")
    assert summary.status_now == ({"passed": 2, status: 1} if status else {"passed": 3})


def test_the_document_of_another_filter_has_each_field_once() -> None:
    decisions = decided([(0.9, 0.8, 0.7, 0.6), (0.5, 0.4, 0.3, 0.2)])
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
def test_each_status_is_counted_as_it_was_and_as_it_would_have_been(at: int) -> None:
    decisions = decided([(0.9, 0.8, 0.7, 0.6)] * 3, status="relaxed")
    decisions[at] = replace(decisions[at], then=replace(decisions[at].then, status="corrected"))
    summary = summary_of(decisions)
    assert (summary.ticks, summary.status_then, summary.status_now) == (
        3, {"passed": 2, "corrected": 1}, {"relaxed": 3},
    )  # fmt: skip
    said = [line.split() for line in what_if_lines(summary, decisions, "eta 0.1") if " then  " in line]
    assert said == [
        ["corrected", "then", "1", "now", "0"], ["passed", "then", "2", "now", "0"],
        ["relaxed", "then", "0", "now", "3"],
    ]  # fmt: skip


@pytest.mark.parametrize(("count", "more"), [(10, False), (11, True)])
def test_ten_decisions_are_told_and_how_many_more_there_are(count: int, more: bool) -> None:
    decisions = decided([(0.9, 0.8, 0.7, 0.6)] * count, status="corrected")
    lines = list(what_if_lines(summary_of(decisions), decisions, "eta 0.1"))
    assert len([line for line in lines if line.startswith("    tick ")]) == 10
    assert any("... and 1 more" in line for line in lines) is more


@pytest.mark.parametrize(
    ("said", "applied", "obeyed"),
    [
        (None, (1.0, 0.0), True),
        ((1.0, 0.0), (1.0, 0.0), True),
        ((1.0, 0.5), (1.0, 0.0), False),
        ((1.0,), (1.0, 0.0), True),
        ((1.0,), (1.0, 0.5), False),
        ((), (), True),
    ],
)
def test_the_other_filter_sees_whether_the_robot_did_what_it_had_said(
    said: tuple[float, ...] | None, applied: tuple[float, ...], obeyed: bool
) -> None:
    """Of the tick before, in the same epoch; of an earlier one it had said nothing about this state."""
    shown = _Hypothetical({})
    if said is not None:
        shown.done(state_of(6), {ACTION: ActionMessage(**stamp(6), values=said)})
    assert shown.state(state_of(7, applied=applied)).applied_by == ("filter" if obeyed else "recorded")
    assert shown.state(state_of(8, applied=applied)).applied_by == "filter"
    assert shown.state(state_of(7, applied=applied, epoch=4)).applied_by == "filter"


def test_a_kind_of_robot_is_known_by_its_numbers_and_by_whether_it_drives_in_a_field() -> None:
    """A robot that speaks ROS drives in a plane: what has as many numbers and no field is another."""
    known = next(robot for robot in robots().values() if robot.ros_face() is not None)
    values, applied = (0.0,) * len(known.system.state), (0.0,) * len(known.system.action)
    path = Path("a.mcap")
    assert _kind_of(path, state_of(1, values=values, applied=applied)).name == known.name
    for wrong in ({"field": ()}, {"values": (*values, 0.0) * 3}, {"applied": (*applied, 0.0) * 3}):
        state = state_of(1, **{"values": values, "applied": applied, **wrong})
        shapes = {(len(one.system.state), len(one.system.action)) for one in robots().values() if not one.ros_face()}
        if (len(state.values), len(state.applied)) in shapes:
            assert _kind_of(path, state).name != known.name
        else:
            with pytest.raises(RunError, match="no known kind of robot"):
                _kind_of(path, state)


@pytest.mark.parametrize("field", [(), (-4.0, 4.0, -4.0, 4.0)])
def test_a_kind_that_speaks_no_ros_is_known_by_its_numbers_alone(field: tuple[float, ...]) -> None:
    """A pendulum has no field to drive in."""
    shapes = [(len(robot.system.state), len(robot.system.action)) for robot in robots().values()]
    alone = [
        robot
        for robot, shape in zip(robots().values(), shapes, strict=True)
        if robot.ros_face() is None and shapes.count(shape) == 1
    ]
    assert "pendulum" in {robot.system.name for robot in alone}
    for robot in alone:
        values, applied = (0.0,) * len(robot.system.state), (0.0,) * len(robot.system.action)
        state = state_of(1, values=values, applied=applied, field=field)
        assert _kind_of(Path("a.mcap"), state).system.name == robot.system.name
