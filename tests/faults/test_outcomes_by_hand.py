"""What a campaign counts of a fault and of several fleets, from traces that are written down by hand."""

from __future__ import annotations

from dataclasses import fields, replace
from types import SimpleNamespace
from typing import Any

import pytest
from tests.faults.test_fault_episode import PERIOD, evidence, lived, trace

from safedpa_lab.faults import campaign
from safedpa_lab.faults.campaign import _Lived, _meanwhile, _outcome
from safedpa_lab.faults.episode import Episode, collisions_in
from safedpa_lab.faults.outcome import Campaign, Outcome, joined
from safedpa_lab.faults.report import _kind_line, _kinds


class Recorded:
    """Which of the stamps that were lived and heard were not recorded."""

    messages = 9

    def __init__(self) -> None:
        self.asked: list[tuple[int, int]] = []

    def lost(self, states: Any, verdicts: Any) -> tuple[int, int]:
        self.asked.append((len(states), len(verdicts)))
        return 2, 1


def fault_of(meanwhile: str = "anything", recovers_within: float = 5.0) -> Any:
    return SimpleNamespace(
        name="kill policy", sentence="it is killed", recovers_within=recovers_within, meanwhile=meanwhile
    )


def lived_through(marks: str, *, meanwhile: str = "anything", troubles: tuple[str, ...] = (), **more: Any) -> _Lived:
    episode = Episode(0.0, 10 * PERIOD, PERIOD * len(marks))
    return _Lived(fault_of(meanwhile, **more), episode, 1.234, 0.5678, troubles)


def test_each_number_of_a_fault_by_hand() -> None:
    """Of 40 periods six by the watchdog, two by a filter that fell back, and two contacts."""
    periods = trace("d" * 8 + "w" * 6 + "d" * 26)
    periods = [replace(one, collisions=(one.tick >= 3) + (one.tick >= 30)) for one in periods]
    found = _outcome(lived_through("d" * 40), evidence(periods, (20, 21, 9)), recorded := Recorded())  # type: ignore[arg-type]
    assert (found.periods, found.watchdog, found.fallbacks, found.collisions) == (40, 6, 2, 2)
    assert (found.speed, found.whole_seconds) == (1.23, 0.568)
    assert (found.states_not_recorded, found.verdicts_not_recorded) == (2, 1)
    assert recorded.asked == [(40, 3)]
    assert not found.held
    assert found.broken[0] == "2 collisions"


@pytest.mark.parametrize(
    ("marks", "troubles", "within", "held"),
    [
        ("d" * 40, (), 5.0, True),
        ("d" * 40, ("",), 5.0, True),
        ("d" * 40, ("", "the recorder failed"), 5.0, False),
        ("d" * 12 + "w" * 10 + "d" * 20, (), 5.0, True),
        ("d" * 12 + "w" * 10 + "d" * 20, (), 0.2, False),
        ("d" * 12 + "w" * 28, (), 5.0, False),
    ],
)
def test_a_fault_held_where_nothing_is_broken(marks: str, troubles: tuple[str, ...], within: float, held: bool) -> None:
    one = lived_through(marks, troubles=troubles, recovers_within=within)
    found = _outcome(one, evidence(trace(marks)), Recorded())  # type: ignore[arg-type]
    assert found.held is held
    assert (found.broken == ()) is held


@pytest.mark.parametrize("stale", [0, 1, 5])
def test_every_stale_action_is_counted_and_three_are_told(stale: int) -> None:
    periods = [replace(lived(tick), action_tick=tick - (tick < stale)) for tick in range(40)]
    found = _outcome(lived_through("d" * 40), evidence(periods), Recorded())  # type: ignore[arg-type]
    assert found.stale_actions == stale
    assert len(found.broken) == min(stale, 3)


@pytest.mark.parametrize(
    ("meanwhile", "marks", "missed"),
    [
        ("anything", "w" * 40, ""),
        ("undisturbed", "d" * 40, ""),
        ("undisturbed", "d" * 36 + "w" * 4, ""),
        ("undisturbed", "d" * 35 + "w" * 5, "88% of the periods were driven, wanted 90%"),
        ("driven", "d" * 3 + "w" * 7 + "w" * 30, ""),
        ("driven", "d" * 2 + "w" * 8 + "d" * 30, "20% of the periods were driven, wanted 30%"),
        ("driven", " " * 10 + "d" * 30, ""),
    ],
)
def test_what_the_loop_had_to_do_during_a_fault_is_a_share_of_its_periods(
    meanwhile: str, marks: str, missed: str
) -> None:
    """``undisturbed`` to the episode's end, else until the fault is mended, after ten periods."""
    one = lived_through(marks, meanwhile=meanwhile)
    assert _meanwhile(one.fault, one.episode, evidence(trace(marks))) == missed


def test_contacts_are_counted_when_they_are_new_and_a_robot_that_starts_anew_begins_with_none() -> None:
    counts = [(5, 2), (5, 2), (5, 3), (5, 5), (6, 0), (6, 1), (5, 5)]
    periods = [replace(lived(tick, epoch=epoch), collisions=count) for tick, (epoch, count) in enumerate(counts)]
    assert collisions_in(periods) == 4
    assert collisions_in([]) == 0


def outcome_of(**changes: Any) -> Outcome:
    usual: dict[str, Any] = {
        "name": "kill policy", "sentence": "", "held": True, "broken": (), "speed": 1.0, "collisions": 0,
        "stale_actions": 0, "periods": 100, "watchdog": 5, "fallbacks": 10, "recovery_seconds": 1.0,
        "whole_seconds": 2.0, "states_not_recorded": 0, "verdicts_not_recorded": 0,
    }  # fmt: skip
    return Outcome(**{**usual, **changes})


def test_of_several_fleets_everything_is_added_up() -> None:
    one = Campaign((outcome_of(),), 1, 2, 3, 4, 5)
    other = Campaign((outcome_of(name="a"), outcome_of(name="b")), 10, 20, 30, 40, 50)
    assert joined([one, other, one]) == Campaign((*one.outcomes, *other.outcomes, *one.outcomes), 12, 24, 36, 48, 60)
    assert joined([]) == Campaign((), 0, 0, 0, 0, 0)


@pytest.mark.parametrize(
    ("changes", "held"),
    [
        ({}, True),
        ({"collisions": 1}, False),
        ({"stale_actions": 1}, False),
        ({"recorded": 9}, False),
        ({"recorded": 10}, True),
        ({"outcomes": (outcome_of(), outcome_of(held=False))}, False),
        ({"outcomes": (outcome_of(held=False), outcome_of())}, False),
    ],
)
def test_a_campaign_held_where_each_fault_did_and_nothing_acknowledged_is_lost(
    changes: dict[str, Any], held: bool
) -> None:
    usual: dict[str, Any] = {"outcomes": (outcome_of(),), "periods": 5, "collisions": 0, "stale_actions": 0}
    assert Campaign(**{**usual, "acknowledged": 10, "recorded": 12, **changes}).held is held


def test_a_line_of_a_kind_of_faults_adds_them_up() -> None:
    rows = [
        {field.name: getattr(outcome, field.name) for field in fields(Outcome)}
        for outcome in (
            outcome_of(name="change-ready policy"), outcome_of(name="change-taken policy", held=False, watchdog=45),
            outcome_of(name="kill policy", periods=300, fallbacks=0),
        )
    ]  # fmt: skip
    kinds = _kinds(rows)
    assert {kind: len(of_kind) for kind, of_kind in kinds.items()} == {"change": 2, "kill": 1}
    cells = [cell.strip() for cell in _kind_line("change", kinds["change"]).split("|")]
    assert cells[1:5] == ["change", "2", "1", "25%, 10%"]


def test_a_campaign_counts_all_that_was_lived_and_all_that_was_acknowledged(monkeypatch: pytest.MonkeyPatch) -> None:
    periods = [replace(lived(tick), collisions=tick // 20, action_tick=tick - (tick == 7)) for tick in range(60)]
    actions = {(5, tick): {(1.0, 0.1)} for tick in range(60)}
    observer = SimpleNamespace(verdicts={}, actions=actions, acknowledged={"one": 30, "two": 12})
    world: Any = SimpleNamespace(observer=observer, recordings=None, trace=None)
    monkeypatch.setattr(campaign, "read_recorded", lambda *_: Recorded())
    monkeypatch.setattr(campaign, "read_trace", lambda _: iter(periods))
    found = campaign._judged(world, [lived_through("d" * 40), lived_through("d" * 20)])
    assert (found.periods, found.collisions, found.stale_actions) == (60, 2, 1)
    assert (found.acknowledged, found.recorded, len(found.outcomes)) == (42, 9, 2)


class Worlds:
    """In place of fleets: after some faults one does not drive on; each fault takes 4 s."""

    def __init__(self, failing: str, monkeypatch: pytest.MonkeyPatch) -> None:
        self.lived: list[list[str]] = []
        self.settings: list[Any] = []
        self.folders: list[str] = []
        self.told: list[tuple[str, int, int]] = []
        self._failing, self._now = failing, 100.0
        monkeypatch.setattr(campaign, "time", SimpleNamespace(monotonic=lambda: self._now))
        monkeypatch.setattr(campaign, "World", self._begun)
        monkeypatch.setattr(campaign, "_run", self._run)
        monkeypatch.setattr(campaign, "_judged", lambda _, lived: Campaign(tuple(lived), len(lived), 0, 0, 0, 0))

    def _begun(self, folder: Any, settings: Any) -> Any:
        self.lived.append([])
        self.settings.append(settings)
        self.folders.append(folder.name)
        return self

    def __enter__(self) -> Worlds:
        return self

    def __exit__(self, *_: object) -> None: ...

    def drives(self) -> bool:
        return self.lived[-1][-1] not in self._failing

    def _run(self, fault: Any, _world: Any, *, is_hasty: bool) -> Any:
        assert not is_hasty
        self.lived[-1].append(fault.name)
        self._now += 4.0
        return SimpleNamespace(name=fault.name, back=None if fault.name == "z" else 0.2)

    def run(self, faults: str, seconds: float) -> Campaign:
        """A small letter is a fault with the product's own diagnosis, a large one with a stand-in."""
        given: Any = [
            SimpleNamespace(name=name, diagnosis="ready" if name.isupper() else "real", seconds=9.0) for name in faults
        ]
        return campaign.run_faults(given, 7, None, lambda *one: self.told.append(one), seconds=seconds)


@pytest.mark.parametrize(
    ("faults", "failing", "seconds", "lived"),
    [
        ("abc", "", 1e9, ["abc"]),
        ("abcd", "b", 1e9, ["ab", "cd"]),  # a fleet that does not recover is replaced
        ("abc", "c", 1e9, ["abc"]),
        ("azbc", "", 1e9, ["az", "bc"]),  # and one of which a process is not back
        ("abCDe", "", 1e9, ["ab", "CD", "e"]),  # another diagnosis is another fleet
        ("abcdef", "", 10.0, ["abc"]),  # after 8 s another one begins, after 12 s none
        ("abcdef", "a", 10.0, ["a", "bc"]),
        ("abcdef", "c", 10.0, ["abc"]),
        ("abcdef", "", 0.0, ["a"]),  # one always
        ("", "", 1e9, []),
    ],
)
def test_faults_go_on_one_fleet_as_long_as_it_drives_and_time_is_left(
    faults: str, failing: str, seconds: float, lived: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    worlds = Worlds(failing, monkeypatch)
    found = worlds.run(faults, seconds)
    assert ["".join(own) for own in worlds.lived] == lived
    assert [outcome.name for outcome in found.outcomes] == list("".join(lived))
    assert found.periods == len("".join(lived))
    assert worlds.told == [(name, done, len(faults)) for done, name in enumerate("".join(lived))]
    assert [one.seed for one in worlds.settings] == [7 + number for number in range(len(lived))]
    assert [one.diagnosis for one in worlds.settings] == ["ready" if own.isupper() else "real" for own in lived]
    assert len(set(worlds.folders)) == len(lived)


@pytest.mark.parametrize(("faults", "disks"), [(1, 1), (100, 1), (101, 2), (250, 3)])
def test_every_hundred_faults_have_a_disk(faults: int, disks: int) -> None:
    assert campaign._disk_bytes(faults) == disks * campaign._disk_bytes(1)


@pytest.mark.parametrize(("speed", "drives", "fast"), [(1.9, True, True), (1.9, False, False), (0.1, True, False)])
def test_a_car_is_fast_where_it_drives_and_its_newest_state_says_so(speed: float, drives: bool, fast: bool) -> None:
    states = {(1, 4): SimpleNamespace(values=(0.0, 0.0, 0.0, 9.0)), (1, 5): SimpleNamespace(values=(0, 0, 0, speed))}
    world: Any = SimpleNamespace(observer=SimpleNamespace(states=states, newest=(1, 5)), drives=lambda: drives)
    assert campaign._is_fast(world) is fast
    assert campaign._speed(SimpleNamespace(observer=SimpleNamespace(states={}, newest=(0, -1)))) == 0.0  # type: ignore[arg-type]
