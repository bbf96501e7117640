"""Which states and outputs a recording lacks: by ticks, by counted steps, and by what other services used."""

from types import SimpleNamespace
from typing import Any

from safedpa.bus import LATENT, NOMINAL
from safedpa.replay.tape import TickGap, gaps_of


def output(epoch: int, tick: int, step: int) -> Any:
    return SimpleNamespace(message=SimpleNamespace(epoch=epoch, tick=tick, step=step))


def tape(states: Any = (), absent: dict[Any, Any] | None = None, **computed: list[tuple[int, int, int]]) -> Any:
    services = {name: [] for name in ("adaptation", "policy", "safety_filter")}
    services |= {name: [output(*own) for own in rows] for name, rows in computed.items()}
    return SimpleNamespace(states=states, computed=services, absent=lambda topic: (absent or {}).get(topic, []))


def test_a_missing_tick_is_a_missing_state() -> None:
    ticks = [(1, 4), (1, 5), (1, 7), (1, 12), (2, 0), (2, 1)]
    assert gaps_of(tape(states=dict.fromkeys(reversed(ticks)))) == [
        TickGap("state", 1, 5, 7, 1), TickGap("state", 1, 7, 12, 4),
    ]  # fmt: skip
    assert gaps_of(tape(states=dict.fromkeys([(1, 4), (2, 9)]))) == [], "a restarted robot counts from its own begin"


def test_a_missing_step_is_a_missing_output() -> None:
    rows = [(1, 10, 1), (1, 11, 2), (1, 14, 5), (1, 15, 6), (1, 20, 8)]
    assert gaps_of(tape(policy=rows)) == [TickGap("policy", 1, 11, 14, 2), TickGap("policy", 1, 15, 20, 1)]
    assert gaps_of(tape(policy=[(1, 10, 1), (1, 11, 3)])) == [TickGap("policy", 1, 10, 11, 1)]
    assert gaps_of(tape(policy=[(1, 10, 5), (2, 0, 9)])) == [], "the robot was restarted"
    assert gaps_of(tape(policy=[(1, 10, 0), (1, 11, 9)])) == [], "the service does not count its steps"
    assert gaps_of(tape(policy=[(1, 10, 9), (1, 11, 1)])) == [], "the service was restarted"


def test_outputs_that_are_missing_at_the_end_are_known_from_the_services_that_used_them() -> None:
    absent = {LATENT: [(1, 6), (1, 8), (1, 7), (1, 3), (1, 5)], NOMINAL: [(2, 0), (2, 1)]}
    found = gaps_of(tape(absent=absent, adaptation=[(1, 4, 1), (1, 5, 2)], policy=[(1, 9, 3)]))
    assert found == [TickGap("adaptation", 1, 5, 9, 3), TickGap("policy", 2, -1, 2, 2)]


def test_gaps_of_states_come_first_and_each_is_a_sentence() -> None:
    states, rows = dict.fromkeys([(1, 0), (1, 2)]), [(1, 0, 1), (1, 2, 3)]
    assert [gap.sentence for gap in gaps_of(tape(states, {NOMINAL: [(1, 9)]}, safety_filter=rows))] == [
        "1 states between tick 0 and tick 2",
        "1 outputs of safety_filter between tick 0 and tick 2",
        "1 outputs of policy between tick -1 and tick 10",
    ]
