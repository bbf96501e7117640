"""What a fault did, from made-up traces: outages, stale actions, collisions."""

from __future__ import annotations

from dataclasses import replace

import pytest

from safedpa.bus import VerdictMessage
from safedpa_lab.faults.episode import Episode, Evidence, collisions_in, recovery_of, stale_in
from safedpa_sim.robots.trace import LivedPeriod

PERIOD = 0.05


def lived(tick: int, by: str = "filter", epoch: int = 5, late: float = 0.0) -> LivedPeriod:
    driven = by == "filter"
    return LivedPeriod(
        epoch=epoch,
        tick=tick,
        published=PERIOD * tick,
        applied_at=PERIOD * (tick + 0.9) + late,
        action_epoch=epoch if driven else -1,
        action_tick=tick if driven else -1,
        applied=(1.0, 0.1) if driven else (0.0, 0.0),
        applied_by=by,
        values=(0.0, 0.0, 0.0, 1.0),
        collisions=0,
    )


def trace(marks: str) -> list[LivedPeriod]:
    """``d``: driven, ``w``: watchdog, a blank: no period lived."""
    kinds = {"d": "filter", "w": "watchdog"}
    return [lived(tick, kinds[mark]) for tick, mark in enumerate(marks) if mark != " "]


def evidence(periods: list[LivedPeriod], fallbacks: tuple[int, ...] = ()) -> Evidence:
    verdicts = {(5, tick): verdict(tick) for tick in fallbacks}
    actions = {(5, one.tick): {(1.0, 0.1)} for one in periods}
    return Evidence(periods, verdicts, actions, PERIOD)


def verdict(tick: int) -> VerdictMessage:
    return VerdictMessage(
        epoch=5, tick=tick, robot_time=0.0, publish_time=0.0, status="fallback", sentence="", action=(), wish=(),
        slack=0.0, active=(), h_now=0.0, h_next=0.0, margin=0.0, solver="", microseconds=0.0,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("marks", "seconds"),
    [
        ("d" * 40, 0.0),
        ("d" * 3 + "wwwww" + "d" * 32, 0.0),  # over before the recovery
        ("d" * 8 + "w" * 6 + "d" * 26, (14.9 - 10) * PERIOD),
        ("d" * 8 + " " * 6 + "d" * 26, (14.9 - 10) * PERIOD),  # a robot that lived nothing meanwhile
        ("d" * 12 + "ww" + "d" * 26, 0.0),  # a hiccup
        ("d" * 16 + "wwww" + "d" * 20, (20.9 - 10) * PERIOD),  # it drove on for a moment, and failed then
        ("d" * 30 + "wwww" + "d" * 6, None),
        ("d" * 8 + "w" * 32, None),
        ("d" * 8 + " " * 32, None),
    ],
)
def test_recovery_counts_to_the_end_of_the_last_outage(marks: str, seconds: float | None) -> None:
    episode = Episode(struck=6 * PERIOD, mended=10 * PERIOD, ended=40 * PERIOD)
    found = recovery_of(evidence(trace(marks)), episode)
    assert found == (seconds if seconds is None else pytest.approx(seconds))


def test_a_fallback_is_an_outage_as_well() -> None:
    episode = Episode(struck=6 * PERIOD, mended=10 * PERIOD, ended=40 * PERIOD)
    found = recovery_of(evidence(trace("d" * 40), fallbacks=(8, 9, 10, 11, 12)), episode)
    assert found == pytest.approx(3.9 * PERIOD)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"action_tick": 2}, "action of tick 2"),
        ({"action_epoch": 4}, "action of tick 3"),
        ({"applied_at": PERIOD * 5.1}, "began to act after 0.105 s"),
        ({"applied": (1.0, 0.2)}, "the filter never sent"),
    ],
)
def test_an_action_that_must_not_act_is_found(changed: dict[str, object], words: str) -> None:
    periods = trace("ddddd")
    assert stale_in(periods, evidence(periods)) == []
    periods[3] = replace(periods[3], **changed)  # type: ignore[arg-type]
    found = stale_in(periods, evidence(periods))
    assert len(found) == 1
    assert words in found[0]


def test_what_the_watchdog_did_is_never_stale_and_what_was_not_heard_is_not_held_against_the_robot() -> None:
    late = [lived(0), lived(1, "watchdog", late=3.0)]
    assert stale_in(late, Evidence(late, {}, {}, PERIOD)) == []


def test_collisions_count_from_the_first_period_of_each_robot() -> None:
    counts = [(5, 2), (5, 2), (5, 3), (5, 5), (6, 0), (6, 1), (5, 5)]
    periods = [replace(lived(tick, epoch=epoch), collisions=count) for tick, (epoch, count) in enumerate(counts)]
    assert collisions_in(periods) == 4
    assert collisions_in([]) == 0


@pytest.mark.parametrize(
    ("sent", "stale"),
    [
        ({(1.0, 0.1)}, 0),
        ({(1.0, 0.1), (0.5, 0.2)}, 0),  # two filters, one of which was obeyed
        ({(0.5, 0.2), (1.0, -0.1), (1.0, 0.1)}, 0),
        ({(0.5, 0.1)}, 1),
        ({(1.0, 0.2), (0.5, 0.1)}, 1),  # one component of each
        (set(), 0),  # nothing was heard
        (None, 0),
    ],
)
def test_an_action_was_sent_if_any_action_for_its_state_equals_it(
    sent: set[tuple[float, ...]] | None, stale: int
) -> None:
    periods = [lived(7)]
    found = stale_in(periods, Evidence(periods, {}, {} if sent is None else {(5, 7): sent}, PERIOD))
    assert len(found) == stale
    assert all("tick 7: the filter never sent" in words for words in found)


@pytest.mark.parametrize(("status", "driven"), [("passed", True), ("corrected", True), ("fallback", False)])
def test_a_period_is_driven_if_the_filter_had_all_its_inputs(status: str, driven: bool) -> None:
    told = {(5, 2): replace(verdict(2), status=status)}
    assert Evidence([], told, {}, PERIOD).is_driven(lived(2)) is driven
    assert not Evidence([], told, {}, PERIOD).is_driven(lived(2, "watchdog"))
    assert Evidence([], {}, {}, PERIOD).is_driven(lived(2)), "its verdict was not heard"


def test_an_outage_that_ends_before_the_recovery_takes_no_time() -> None:
    """The action of tick 9 acts a tenth of a period before the recovery."""
    episode = Episode(struck=6 * PERIOD, mended=10 * PERIOD, ended=40 * PERIOD)
    assert recovery_of(evidence(trace("d" * 6 + "www" + "d" * 31)), episode) == 0.0
    assert recovery_of(evidence(trace("d" * 6 + "wwww" + "d" * 30)), episode) == pytest.approx(0.9 * PERIOD)
