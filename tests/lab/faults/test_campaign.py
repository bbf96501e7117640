"""Campaigns of faults: what is counted of one, what is required, the page, and a few faults on a real fleet."""

from __future__ import annotations

import itertools
import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from tests.messages import verdict_of

from safedpa.errors import InputError
from safedpa_lab.experiments.report import output_folder, write_report
from safedpa_lab.experiments.table import EXPERIMENTS
from safedpa_lab.faults import campaign
from safedpa_lab.faults.campaign import run_faults
from safedpa_lab.faults.episode import (
    Campaign,
    Episode,
    Evidence,
    Outcome,
    collisions_in,
    joined,
    recovery_of,
    stale_in,
)
from safedpa_lab.faults.experiment import all_faults, faults_named, markdown_of, small_faults
from safedpa_lab.faults.fault import Fault
from safedpa_sim.robots.run_summary import TracedPeriod

PERIOD = 0.05


def lived(tick: int, by: str = "filter", epoch: int = 5, late: float = 0.0) -> TracedPeriod:
    driven = by == "filter"
    return TracedPeriod(
        epoch=epoch, tick=tick, published=PERIOD * tick, applied_at=PERIOD * (tick + 0.9) + late,
        action_epoch=epoch if driven else -1, action_tick=tick if driven else -1,
        applied=(1.0, 0.1) if driven else (0.0, 0.0), applied_by=by, values=(0.0, 0.0, 0.0, 1.0), collisions=0,
    )  # fmt: skip


def trace(marks: str) -> list[TracedPeriod]:
    """``d``: driven, ``w``: watchdog, a blank: no period lived."""
    kinds = {"d": "filter", "w": "watchdog"}
    return [lived(tick, kinds[mark]) for tick, mark in enumerate(marks) if mark != " "]


def evidence(periods: list[TracedPeriod], fallbacks: tuple[int, ...] = ()) -> Evidence:
    verdicts = {(5, tick): verdict_of("fallback", epoch=5, tick=tick) for tick in fallbacks}
    actions = {(5, one.tick): {(1.0, 0.1)} for one in periods}
    return Evidence(periods, verdicts, actions, PERIOD)


@pytest.mark.parametrize(
    ("marks", "fallbacks", "seconds"),
    [
        ("d" * 40, (), 0.0),
        ("d" * 40, (8, 9, 10, 11, 12), 3.9 * PERIOD),  # a fallback is an outage as well
        ("d" * 3 + "wwwww" + "d" * 32, (), 0.0),  # over before the recovery
        ("d" * 6 + "www" + "d" * 31, (), 0.0),  # the action of tick 9 acts a tenth of a period before it
        ("d" * 6 + "wwww" + "d" * 30, (), 0.9 * PERIOD),
        ("d" * 8 + "w" * 6 + "d" * 26, (), (14.9 - 10) * PERIOD),
        ("d" * 8 + " " * 6 + "d" * 26, (), (14.9 - 10) * PERIOD),  # a robot that lived nothing meanwhile
        ("d" * 12 + "ww" + "d" * 26, (), 0.0),  # a hiccup
        ("d" * 16 + "wwww" + "d" * 20, (), (20.9 - 10) * PERIOD),  # it drove on for a moment, and failed then
        ("d" * 30 + "wwww" + "d" * 6, (), None), ("d" * 8 + "w" * 32, (), None), ("d" * 8 + " " * 32, (), None),
    ],
)  # fmt: skip
def test_recovery_counts_to_the_end_of_the_last_outage(marks, fallbacks, seconds) -> None:
    episode = Episode(struck=6 * PERIOD, corrected=10 * PERIOD, ended=40 * PERIOD)
    found = recovery_of(evidence(trace(marks), fallbacks), episode)
    assert found == (seconds if seconds is None else pytest.approx(seconds))


@pytest.mark.parametrize(
    ("changed", "phrase"),
    [
        ({"action_tick": 2}, "action of tick 2"), ({"action_epoch": 4}, "action of tick 3"),
        ({"applied_at": PERIOD * 5.1}, "began to act after 0.105 s"),
        ({"applied": (1.0, 0.2)}, "the filter never sent"),
    ],
)  # fmt: skip
def test_an_action_that_must_not_act_is_found(changed: Any, phrase: str) -> None:
    periods = trace("ddddd")
    assert stale_in(periods, evidence(periods)) == []
    periods[3] = replace(periods[3], **changed)
    (found,) = stale_in(periods, evidence(periods))
    assert phrase in found


def test_what_the_watchdog_did_is_never_stale_and_what_was_not_heard_is_not_held_against_the_robot() -> None:
    late = [lived(0), lived(1, "watchdog", late=3.0)]
    assert stale_in(late, Evidence(late, {}, {}, PERIOD)) == []


def test_collisions_count_from_the_first_period_of_each_robot() -> None:
    counts = [(5, 2), (5, 2), (5, 3), (5, 5), (6, 0), (6, 1), (5, 5)]
    periods = [replace(lived(tick, epoch=epoch), collisions=count) for tick, (epoch, count) in enumerate(counts)]
    assert (collisions_in(periods), collisions_in([])) == (4, 0)


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
def test_an_action_was_sent_if_any_action_for_its_state_equals_it(sent, stale) -> None:
    periods = [lived(7)]
    found = stale_in(periods, Evidence(periods, {}, {} if sent is None else {(5, 7): sent}, PERIOD))
    assert len(found) == stale
    assert all("tick 7: the filter never sent" in phrase for phrase in found)


@pytest.mark.parametrize(("status", "driven"), [("passed", True), ("corrected", True), ("fallback", False)])
def test_a_period_is_driven_if_the_filter_had_all_its_inputs(status: str, driven: bool) -> None:
    reported = {(5, 2): verdict_of(status, epoch=5, tick=2)}
    assert Evidence([], reported, {}, PERIOD).is_driven(lived(2)) is driven
    assert not Evidence([], reported, {}, PERIOD).is_driven(lived(2, "watchdog"))
    assert Evidence([], {}, {}, PERIOD).is_driven(lived(2)), "its verdict was not heard"


TURN = 0.02
"""s between two looks of a fleet."""


@dataclass
class Script:
    """What all fleets of a campaign do, by a clock of their own."""

    marks: str = "d" * 30
    """Periods from the fault on, see ``trace``."""
    change: Callable[[TracedPeriod], dict[str, Any]] = lambda _: {}
    fallbacks: tuple[int, ...] = ()
    failing: str = ""
    """Faults after which a fleet does not drive on."""
    absent: str = ""
    """Faults after which a process does not come back."""
    away: float = 0.0
    """s for which a process is away otherwise."""
    speeds: list[float] = field(default_factory=lambda: [1.234])
    """m/s: at first, and after a restart of the robot."""
    now: float = 0.0
    struck: list[float] = field(default_factory=list)
    corrected: list[float] = field(default_factory=list)
    fleets: list[Fleet] = field(default_factory=list)
    lost: list[tuple[int, int]] = field(default_factory=list)

    def fault(self, name: str = "kill policy", seconds: float = 10 * PERIOD, **changes: Any) -> Fault:
        """A fault that notes when it struck and was corrected; one with a capital wants the stand-in for a
        diagnosis."""
        return Fault(
            name, "it is killed", strike=lambda _: self._strike(name), repair=lambda _: self.corrected.append(self.now),
            seconds=seconds, diagnosis="ready" if name.isupper() else "real", **{"recovers_within": 5.0, **changes},
        )  # fmt: skip

    def _strike(self, name: str) -> None:
        self.struck.append(self.now)
        self.fleets[-1].suffered.append(name)

    def periods(self) -> list[TracedPeriod]:
        """The trace, from the first fault on."""
        at = self.struck[0]
        return [
            replace(one, published=one.published + at, applied_at=one.applied_at + at, **self.change(one))
            for one in trace(self.marks)
        ]

    def recorded(self) -> Any:
        """Two states and one verdict of each fault are in no recording; nine messages are."""

        def lost(states: Any, verdicts: Any) -> tuple[int, int]:
            self.lost.append((len(states), len(verdicts)))
            return 2, 1

        return SimpleNamespace(messages=9, lost=lost)


class Fleet:
    """In place of a world of processes."""

    trace, recordings = None, ()

    def __init__(self, script: Script, folder: Any, settings: Any) -> None:
        self.script, self.folder, self.settings = script, folder, settings
        self.suffered: list[str] = []
        self.restarts = 0
        member = SimpleNamespace(fate=lambda: "it ended", restart=self._restart)
        self.members: Any = {"robot": member, "policy": member}
        script.fleets.append(self)

    @property
    def observer(self) -> Any:
        speed = self.script.speeds[min(self.restarts, len(self.script.speeds) - 1)]
        states = {(5, tick): SimpleNamespace(values=(0.0, 0.0, 0.0, v)) for tick, v in ((1, 9.0), (2, speed))}
        return SimpleNamespace(
            states=states, newest=(5, 2),
            verdicts={(5, tick): verdict_of("fallback", epoch=5, tick=tick) for tick in self.script.fallbacks},
            actions={(5, tick): {(1.0, 0.1)} for tick in range(99)}, acknowledged={"one": 30, "two": 12},
        )  # fmt: skip

    def __enter__(self) -> Fleet:
        return self

    def __exit__(self, *_: object) -> None: ...

    def until(self, condition: Callable[[], bool], patience: float) -> bool:
        end = self.script.now + patience
        while not condition():
            if self.script.now >= end - 1e-9:
                return False
            self.script.now = min(end, self.script.now + TURN)
        return True

    def listen(self, seconds: float) -> None:
        self.until(lambda: False, seconds)

    def drives(self, since: float = 0.0) -> bool:
        del since
        return not self.suffered or self.suffered[-1] not in self.script.failing

    def drives_steadily(self) -> bool:
        return True

    def missing(self, since: float) -> list[str]:
        gone = self.suffered and self.suffered[-1] in self.script.absent
        return ["policy"] if since and (gone or self.script.now < since + self.script.away) else []

    def _restart(self) -> None:
        self.restarts += 1


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Campaign]:
    def run(script: Script, faults: Any = None, **options: Any) -> Campaign:
        monkeypatch.setattr(time, "monotonic", lambda: script.now)
        monkeypatch.setattr(campaign, "World", lambda folder, settings: Fleet(script, folder, settings))
        monkeypatch.setattr(campaign, "read_recorded", lambda *_: script.recorded())
        monkeypatch.setattr(campaign, "read_trace", lambda _: iter(script.periods()))
        return campaign.run_faults([script.fault()] if faults is None else faults, 7, **options)

    return run


def one(found: Campaign) -> Outcome:
    (outcome,) = found.outcomes
    return outcome


def test_each_figure_of_a_fault_is_counted_from_the_trace(run: Any) -> None:
    """Of 40 periods six are braked by the watchdog and two by a filter that fell back; there are two contacts."""
    touches = lambda period: {"collisions": (period.tick >= 3) + (period.tick >= 30)}  # noqa: E731
    script = Script("d" * 8 + "w" * 6 + "d" * 26, touches, (20, 24, 9), away=0.56)
    found = run(script)
    outcome = one(found)
    assert (outcome.periods, outcome.watchdog, outcome.fallbacks, outcome.collisions) == (40, 6, 2, 2)
    assert (outcome.speed, outcome.whole_seconds) == (1.23, pytest.approx(0.56, abs=TURN))
    assert outcome.recovery_seconds == pytest.approx((14.9 - 10) * PERIOD, abs=2e-3)
    assert (outcome.states_not_recorded, outcome.verdicts_not_recorded) == (2, 1)
    assert script.lost == [(40, 3)]
    assert (outcome.held, outcome.broken) == (False, ("2 collisions",))
    assert (found.periods, found.collisions, found.acknowledged, found.recorded) == (40, 2, 42, 9)


@pytest.mark.parametrize(
    ("marks", "changes", "broken"),
    [
        ("d" * 30, {}, []),
        ("d" * 12 + "w" * 6 + "d" * 12, {}, []),
        ("d" * 12 + "w" * 6 + "d" * 12, {"recovers_within": 0.2}, ["does not drive 0 s after the recovery"]),
        ("d" * 12 + "w" * 18, {}, ["does not drive 5 s after the recovery"]),
        ("d" * 30, {"look": lambda _: "it went on", "check": lambda *_: "mixed"}, ["it went on", "mixed"]),
        ("d" * 28 + "w" * 2, {"meanwhile": "undisturbed"}, []),
        ("d" * 4 + "w" * 6 + "d" * 20, {"meanwhile": "undisturbed"}, ["80% of the periods were driven, wanted 90%"]),
        ("d" * 3 + "w" * 7 + "d" * 20, {"meanwhile": "drives"}, []),
        ("d" * 2 + "w" * 8 + "d" * 20, {"meanwhile": "drives"}, ["20% of the periods were driven, wanted 30%"]),
        (" " * 10 + "d" * 20, {"meanwhile": "drives"}, []),
        ("w" * 10 + "d" * 20, {"meanwhile": "anything"}, []),
    ],
)  # fmt: skip
def test_a_fault_held_if_nothing_was_broken(marks: str, changes: dict[str, Any], broken: list[str], run: Any) -> None:
    """``undisturbed`` counts to the end of the episode, otherwise to the recovery after ten periods."""
    script = Script(marks)
    outcome = one(run(script, [script.fault(**changes)]))
    assert (list(outcome.broken), outcome.held) == (broken, not broken)


@pytest.mark.parametrize("stale", [0, 1, 5])
def test_every_stale_action_is_counted_and_three_are_described(stale: int, run: Any) -> None:
    found = run(Script(change=lambda one: {"action_tick": one.tick - (one.tick < stale)}))
    assert (one(found).stale_actions, found.stale_actions) == (stale, stale)
    assert len(one(found).broken) == min(stale, 3)


def test_a_process_that_does_not_come_back_breaks_the_fault(run: Any) -> None:
    outcome = one(run(Script(absent="kill policy")))
    assert outcome.whole_seconds is None
    assert "policy is not back, it ended" in outcome.broken


def test_what_a_fault_started_is_ended_even_if_striking_fails(run: Any) -> None:
    script = Script()

    def fails(_: Any) -> None:
        raise RuntimeError("planted")

    with pytest.raises(RuntimeError, match="planted"):
        run(script, [replace(script.fault(), strike=fails)])
    assert len(script.corrected) == 1


@pytest.mark.parametrize(("hasty", "lasts"), [(False, 9.0), (True, 1.5)])
def test_a_hasty_fault_lasts_at_most_a_second_and_a_half(hasty: bool, lasts: float, run: Any) -> None:
    script = Script()
    run(script, [script.fault(seconds=9.0)], is_hasty=hasty)
    assert script.corrected[0] - script.struck[0] == pytest.approx(lasts)


@pytest.mark.parametrize(
    ("speeds", "hasty", "restarts", "waited"),
    [([1.9], False, 0, 0.0), ([0.1, 1.9], False, 1, 6.0), ([0.1, 1.9], True, 0, 1.5), ([0.1, 0.1], False, 1, 26.0)],
)
def test_a_fault_strikes_while_the_car_is_fast(speeds, hasty, restarts, waited, run) -> None:
    """A slow car is put back to its start after a few seconds, from where it drives off at once."""
    script = Script(speeds=speeds)
    run(script, is_hasty=hasty)
    assert script.fleets[0].restarts == restarts
    assert script.struck[0] == pytest.approx(waited, abs=PERIOD + TURN), "at some moment of a period"


@pytest.mark.parametrize(
    ("faults", "failing", "absent", "seconds", "suffered"),
    [
        ("abc", "", "", 1e9, ["abc"]),
        ("abcd", "b", "", 1e9, ["ab", "cd"]),  # a fleet that does not recover is replaced
        ("abc", "c", "", 1e9, ["abc"]),
        ("abcd", "", "b", 1e9, ["ab", "cd"]),  # and one in which a process is not back
        ("abCDe", "", "", 1e9, ["ab", "CD", "e"]),  # another diagnosis needs another fleet
        ("abcdef", "", "", 10.0, ["abc"]),  # after 8 s another fault begins, after 12 s none
        ("abcdef", "a", "", 30.0, ["a", "b"]),
        ("abcdef", "", "", 0.0, ["a"]),  # always one
        ("", "", "", 1e9, []),
    ],
)
def test_faults_strike_one_fleet_as_long_as_it_drives_and_time_is_left(faults, failing, absent, seconds, suffered, run):
    script = Script(failing=failing, absent=absent)
    reported: list[tuple[str, int, int]] = []
    names = "".join(suffered)
    given = [script.fault(name, seconds=2.25) for name in faults]
    found = run(script, given, report_progress=lambda *progress: reported.append(progress), seconds=seconds)
    assert ["".join(fleet.suffered) for fleet in script.fleets] == suffered
    assert [outcome.name for outcome in found.outcomes] == list(names)
    assert reported == [(name, done, len(faults)) for done, name in enumerate(names)]
    assert [fleet.settings.seed for fleet in script.fleets] == [7 + number for number in range(len(suffered))]
    assert [fleet.settings.diagnosis for fleet in script.fleets] == [
        "ready" if n.isupper() else "real" for n in suffered
    ]
    assert len({fleet.folder for fleet in script.fleets}) == len(suffered)


@pytest.mark.parametrize(("faults", "disks"), [(1, 1), (100, 1), (101, 2), (250, 3)])
def test_a_recorder_gets_another_disk_for_every_hundred_faults(faults: int, disks: int, run: Any) -> None:
    script, other = Script(), Script()
    run(script, [script.fault(str(number)) for number in range(faults)], seconds=0.0)
    run(other, [other.fault()])
    assert script.fleets[0].settings.disk_bytes == disks * other.fleets[0].settings.disk_bytes


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.processes
def test_whatever_fails_the_robot_is_safe_and_drives_again(tmp_path: Path) -> None:
    campaign = run_faults(small_faults(), folder=tmp_path, is_hasty=True)
    by_name = {outcome.name: outcome for outcome in campaign.outcomes}
    assert {name: outcome.broken for name, outcome in by_name.items() if not outcome.held} == {}
    assert campaign.recorded >= campaign.acknowledged > 0
    assert by_name["kill safety_filter"].watchdog > 0, "the robot braked by itself while there was no filter"
    assert by_name["stop robot"].periods > 0
    assert by_name["hang safety_filter"].watchdog >= 20, "1.5 s in which the filter lives and does not answer"
    assert by_name["disconnect robot"].watchdog >= 25, "1.5 s without a network"
    assert by_name["change-take adaptation"].fallbacks > 0, "no latent of another model is taken"
    assert sum(outcome.collisions + outcome.stale_actions for outcome in campaign.outcomes) == 0


@pytest.mark.slow
def test_every_fault_has_a_name_of_its_own_and_is_found_by_it() -> None:
    faults = all_faults()
    assert len({fault.name for fault in faults}) == len(faults) >= 50
    assert [fault.name for fault in faults_named("kill robot")] == ["kill robot"]
    assert len(faults_named("kill")) == 8
    with pytest.raises(InputError, match="did you mean 'kill robot'"):
        faults_named("kill robots")


@pytest.mark.slow
def test_faults_with_another_diagnosis_are_consecutive() -> None:
    """Else the campaign would begin a new fleet for each."""
    kinds = [fault.diagnosis for fault in all_faults()]
    assert sum(one != other for one, other in itertools.pairwise(kinds)) == 1


@pytest.mark.slow
@pytest.mark.parametrize("fault", all_faults(), ids=lambda fault: fault.name)
def test_a_fault_says_what_it_does_and_who_looks_on_is_never_noticed(fault: Fault) -> None:
    assert fault.sentence
    target = fault.name.split()[-1]
    if fault.diagnosis == "real" and target in ("diagnosis", "recorder"):
        assert fault.meanwhile == "undisturbed"


def outcome(name: str, *broken: str, recovery: float | None = 0.5) -> Outcome:
    return Outcome(
        name=name, sentence=f"{name} happens", held=not broken, broken=broken, speed=1.2, collisions=0, stale_actions=0,
        periods=40, watchdog=10, fallbacks=2, recovery_seconds=recovery, whole_seconds=0.7, states_not_recorded=3,
        verdicts_not_recorded=1,
    )  # fmt: skip


def campaign_report(*outcomes: Outcome, collisions: int = 0, recorded: int = 90) -> Campaign:
    return Campaign(outcomes, 80, collisions, 0, acknowledged=85, recorded=recorded)


def result(found: Campaign) -> dict[str, Any]:
    about = {"command": "safedpa experiment faults", "date": "2026-11-21", "seconds": 9.0, "cores": 2}
    load = {"load_before": 1.0, "load_after": 2.0}
    return {**asdict(found), **about, **load, "rows": [asdict(one) for one in found.outcomes]}


def test_the_page_names_every_fault_its_kind_and_what_did_not_hold() -> None:
    faults = (
        outcome("kill policy"),
        outcome("kill robot", "2 collisions", recovery=None),
        outcome("change-take policy"),
        outcome("change-ready policy", "mixed"),
    )
    page = markdown_of(result(campaign_report(*faults)))
    assert "**2 of 4 held; 0 collisions, 0 stale actions in 80 periods" in page
    assert "| kill | 2 | 1 | 25%, 5% | 0.50, 1 never | 0.70 to 0.70 |" in page
    assert "| change | 2 | 1 | 25%, 5% | 0.50 to 0.50 | 0.70 to 0.70 |" in page, "whatever the moment of the change"
    assert "| kill robot | kill robot happens | **no** |" in page
    assert "- kill robot: 2 collisions" in page
    for line in page.splitlines():
        if line.startswith("| kill robot"):
            assert line.count("|") == 13


@pytest.mark.parametrize(
    ("found", "held"),
    [
        (campaign_report(outcome("kill policy")), True),
        (campaign_report(outcome("kill policy", "slow")), False),
        (campaign_report(outcome("kill policy"), collisions=1), False),
        (campaign_report(outcome("kill policy"), recorded=84), False),
        (campaign_report(outcome("kill policy"), recorded=85), True),
        (replace(campaign_report(outcome("kill policy")), stale_actions=1), False),
        (campaign_report(outcome("kill policy"), outcome("kill robot", "slow")), False),
        (
            joined([campaign_report(outcome("kill policy")), campaign_report(outcome("kill robot"), collisions=1)]),
            False,
        ),
    ],
)
def test_a_campaign_holds_only_if_everything_held_between_the_faults_too(found: Campaign, held: bool) -> None:
    assert found.held is held


def test_several_fleets_are_added_up() -> None:
    one, other = Campaign((outcome("a"),), 1, 2, 3, 4, 5), Campaign((outcome("b"), outcome("c")), 10, 20, 30, 40, 50)
    assert joined([one, other, one]) == Campaign((*one.outcomes, *other.outcomes, *one.outcomes), 12, 24, 36, 48, 60)
    assert joined([]) == Campaign((), 0, 0, 0, 0, 0)


def test_the_report_is_two_files_or_one_line_of_complaint(tmp_path: Path) -> None:
    reported = result(campaign_report(outcome("kill policy")))
    with output_folder(tmp_path / "out"):
        write_report(EXPERIMENTS["faults"], reported, {"out": tmp_path / "out"})
    assert json.loads((tmp_path / "out" / "faults.json").read_text())["rows"][0]["name"] == "kill policy"
    assert (tmp_path / "out" / "faults.md").read_text().rstrip() == markdown_of(reported).rstrip()
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="--out"), output_folder(tmp_path / "file"):
        pass
