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


def test_collisions_count_from_the_first_period_and_a_new_robot_begins_anew() -> None:
    counts = [(5, 2), (5, 2), (5, 3), (6, 0), (6, 1), (6, 1)]
    periods = [replace(lived(tick, epoch=epoch), collisions=count) for tick, (epoch, count) in enumerate(counts)]
    assert collisions_in(periods) == 2
    assert collisions_in([]) == 0
