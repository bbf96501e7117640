"""Which states and outputs a recording lacks, by ticks, by counted steps and by what others used, by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from safedpa.bus import LATENT, WISH
from safedpa.replay.gaps import TickGap, gaps_of


def output(epoch: int, tick: int, step: int) -> Any:
    return SimpleNamespace(message=SimpleNamespace(epoch=epoch, tick=tick, step=step))


def tape(states: Any = (), absent: dict[Any, Any] | None = None, **computed: list[tuple[int, int, int]]) -> Any:
    services = {name: [] for name in ("adaptation", "policy", "safety_filter")}
    services |= {name: [output(*own) for own in rows] for name, rows in computed.items()}
    return SimpleNamespace(states=states, computed=services, absent=lambda topic: (absent or {}).get(topic, []))


def test_a_tick_that_is_left_out_is_a_state_that_was_lost() -> None:
    ticks = [(1, 4), (1, 5), (1, 7), (1, 12), (2, 0), (2, 1)]
    assert gaps_of(tape(states=dict.fromkeys(reversed(ticks)))) == [
        TickGap("state", 1, 5, 7, 1), TickGap("state", 1, 7, 12, 4),
    ]  # fmt: skip
    assert gaps_of(tape(states=dict.fromkeys([(1, 4), (2, 9)]))) == [], "a robot that begins anew counts anew"


def test_a_step_that_is_left_out_is_an_output_that_was_lost() -> None:
    rows = [(1, 10, 1), (1, 11, 2), (1, 14, 5), (1, 15, 6), (1, 20, 8)]
    assert gaps_of(tape(policy=rows)) == [TickGap("policy", 1, 11, 14, 2), TickGap("policy", 1, 15, 20, 1)]
    assert gaps_of(tape(policy=[(1, 10, 5), (2, 0, 9)])) == [], "of another life of the robot"
    assert gaps_of(tape(policy=[(1, 10, 0), (1, 11, 9)])) == [], "who counts no steps, or began anew, tells of none"
    assert gaps_of(tape(policy=[(1, 10, 9), (1, 11, 1)])) == [], "a service that was started again"
    assert gaps_of(tape(policy=[(1, 10, 1), (1, 11, 3)])) == [TickGap("policy", 1, 10, 11, 1)]


def test_what_was_lost_at_the_very_end_is_told_by_who_used_it() -> None:
    absent = {LATENT: [(1, 6), (1, 8), (1, 7), (1, 3), (1, 5)], WISH: [(2, 0), (2, 1)]}
    found = gaps_of(tape(absent=absent, adaptation=[(1, 4, 1), (1, 5, 2)], policy=[(1, 9, 3)]))
    assert found == [TickGap("adaptation", 1, 5, 9, 3), TickGap("policy", 2, -1, 2, 2)]


def test_states_come_first_and_a_gap_is_told_in_words() -> None:
    found = gaps_of(
        tape(states=dict.fromkeys([(1, 0), (1, 2)]), absent={WISH: [(1, 9)]}, safety_filter=[(1, 0, 1), (1, 2, 3)])
    )
    assert [gap.sentence for gap in found] == [
        "1 states between tick 0 and tick 2",
        "1 outputs of safety_filter between tick 0 and tick 2",
        "1 outputs of policy between tick -1 and tick 10",
    ]
