"""A campaign on fleets that follow a script: what it counts, what it requires, and when it takes another fleet."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import pytest
from tests.lab.faults.test_fault_episode import PERIOD, trace, verdict

from safedpa_lab.faults import campaign
from safedpa_lab.faults.fault import Fault
from safedpa_lab.faults.outcome import Campaign, Outcome
from safedpa_sim.robots.trace import LivedPeriod

TURN = 0.02
"""s between two looks of a fleet."""


@dataclass
class Script:
    """What all fleets of a campaign do, by a clock of their own."""

    marks: str = "d" * 30
    """Periods from the fault on, see ``trace``."""
    change: Callable[[LivedPeriod], dict[str, Any]] = lambda _: {}
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
    mended: list[float] = field(default_factory=list)
    fleets: list[Fleet] = field(default_factory=list)
    lost: list[tuple[int, int]] = field(default_factory=list)

    def fault(self, name: str = "kill policy", seconds: float = 10 * PERIOD, **changes: Any) -> Fault:
        """A fault that notes when it struck and was mended; one with a capital wants the stand-in for a diagnosis."""
        return Fault(
            name, "it is killed", strike=lambda _: self._strike(name), mend=lambda _: self.mended.append(self.now),
            seconds=seconds, diagnosis="ready" if name.isupper() else "real", **{"recovers_within": 5.0, **changes},
        )  # fmt: skip

    def _strike(self, name: str) -> None:
        self.struck.append(self.now)
        self.fleets[-1].suffered.append(name)

    def periods(self) -> list[LivedPeriod]:
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
            states=states, newest=(5, 2), verdicts={(5, tick): verdict(tick) for tick in self.script.fallbacks},
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
    assert len(script.mended) == 1


@pytest.mark.parametrize(("hasty", "lasts"), [(False, 9.0), (True, 1.5)])
def test_a_hasty_fault_lasts_at_most_a_second_and_a_half(hasty: bool, lasts: float, run: Any) -> None:
    script = Script()
    run(script, [script.fault(seconds=9.0)], is_hasty=hasty)
    assert script.mended[0] - script.struck[0] == pytest.approx(lasts)


@pytest.mark.parametrize(
    ("speeds", "hasty", "restarts", "waited"),
    [([1.9], False, 0, 0.0), ([0.1, 1.9], False, 1, 6.0), ([0.1, 1.9], True, 0, 1.5), ([0.1, 0.1], False, 1, 26.0)],
)
def test_a_fault_strikes_while_the_car_is_fast(
    speeds: list[float], hasty: bool, restarts: int, waited: float, run: Any
) -> None:
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
def test_faults_strike_one_fleet_as_long_as_it_drives_and_time_is_left(
    faults: str, failing: str, absent: str, seconds: float, suffered: list[str], run: Any
) -> None:
    script = Script(failing=failing, absent=absent)
    told: list[tuple[str, int, int]] = []
    names = "".join(suffered)
    given = [script.fault(name, seconds=2.25) for name in faults]
    found = run(script, given, tell=lambda *progress: told.append(progress), seconds=seconds)
    assert ["".join(fleet.suffered) for fleet in script.fleets] == suffered
    assert [outcome.name for outcome in found.outcomes] == list(names)
    assert told == [(name, done, len(faults)) for done, name in enumerate(names)]
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
