"""How long loops are turned at the end, what a journal tells once, and who opens what comes for several."""

from __future__ import annotations

import subprocess
import sys
from types import SimpleNamespace
from typing import Any

import msgpack
import pytest

from safedpa.bus import STATE, FindingMessage, Inbox, VerdictMessage, decode
from safedpa.bus.loop import turning as module
from safedpa.bus.loop.journal import Journal
from safedpa.bus.loop.turning import Turning, quantum_for
from safedpa.bus.transport.bundle import packed
from safedpa.bus.transport.in_process import _spread
from safedpa.bus.transport.intake import Intake
from safedpa.bus.wire.codec import _LARGEST_BY_FIELD, LARGEST_BYTES
from safedpa.bus.wire.messages import ModelMessage
from safedpa.bus.wire.topics import BUNDLE
from safedpa.errors import MessageError

STAMP = {"epoch": 1, "tick": 7, "robot_time": 0.0, "publish_time": 0.0}


class Loop:
    """A loop whose turns take as long as it may wait; needed until ``until`` [s]."""

    def __init__(self, now: list[float], until: float) -> None:
        self.now, self.until, self.quantum, self.wanted_quantum = now, until, 0.0, 0.0
        self.inbox = SimpleNamespace(lead=lambda _: None, waiting=True)
        self.ended, self.waits = 0, list[float]()

    def clock(self) -> float:
        return self.now[0]

    def patience(self, longest: float) -> float:
        self.waits.append(longest)
        return longest

    def turn(self, _: float) -> None:
        self.now[0] += self.waits[-1]

    def coalesce(self, quantum: float) -> None:
        self.quantum = quantum

    def wind_up(self) -> None:
        self.ended += 1

    @property
    def is_needed(self) -> bool:
        return self.now[0] < self.until


@pytest.mark.parametrize(
    ("needed", "turned"),
    [((0.0, 0.0), 0.0), ((1.0, 0.0), 1.0), ((0.0, 1.0), 1.0), ((9.0, 0.0), 5.0), ((9.0, 9.0), 5.0)],
)
def test_at_the_end_loops_are_turned_until_none_is_needed_and_five_seconds_at_most(
    needed: tuple[float, float], turned: float
) -> None:
    """While they drive it is looked four times a second whether they shall; at the end twenty times."""
    now = [0.0]
    loops = [Loop(now, 100.0 + until) for until in needed]
    stops = iter([False] * 4)

    def stopped() -> bool:
        if next(stops, None) is None:
            now[0] = max(now[0], 100.0)
            return True
        return False

    looked: list[float] = []
    turning = Turning(loops)  # type: ignore[arg-type]
    turn = turning._turn

    def noted(wait: float) -> None:
        looked.append(wait)
        turn(wait)
        now[0] -= wait  # of the second loop, which is turned in the same time

    turning._turn = noted  # type: ignore[method-assign]
    turning.run(stopped)
    assert [loop.ended for loop in loops] == [1, 1]
    assert now[0] - 100.0 == pytest.approx(turned, abs=0.051)
    assert looked[:4] == [0.25] * 4
    assert all(wait <= 0.1 for wait in looked[4:])


@pytest.mark.parametrize(
    ("count", "period", "coalescing", "quantum"),
    [
        (7, 0.05, False, 0.0),
        (8, 0.05, False, 0.0015),
        (4, 0.05, True, 0.0015),
        (3, 0.05, True, 0.0),
        (8, 0.03, False, 0.0),  # less than sleeping costs
        (8, 0.0, False, 0.0),  # in lockstep
    ],
)
def test_batches_are_made_of_eight_robots_and_until_there_are_less_than_four(
    count: int, period: float, coalescing: bool, quantum: float
) -> None:
    periods = [0.1] * (count - 1) + [period]
    assert quantum_for(periods, coalescing=coalescing) == pytest.approx(quantum)
    assert module.LONGEST_HOLD_SECONDS <= 0.01


def verdict_of(status: str, tick: int) -> VerdictMessage:
    return VerdictMessage(
        **{**STAMP, "tick": tick}, status=status, sentence=f"it is {status}", action=(), wish=(), slack=0.0, active=(),
        h_now=0.0, h_next=0.0, margin=0.0, solver="", microseconds=0.0,
    )  # fmt: skip


def finding_of(stage: str) -> FindingMessage:
    return FindingMessage(
        **STAMP, model="m", stage=stage, sentence=f"it is {stage}", number=1, error=0.0, band=0.0,
        evidence=0.0, threshold=0.0, coverage=1.0, where="",
    )  # fmt: skip


class Told:
    def __init__(self) -> None:
        self.events: list[tuple[str, str]] = []
        self.journal = Journal("policy", lambda kind, sentence, **_: self.events.append((kind, sentence)))

    def hears(self, message: Any, robot: str = "r1") -> list[str]:
        before = len(self.events)
        self.journal.said(robot, {STATE: message})
        return [kind for kind, _ in self.events[before:]]


def test_a_stage_of_the_diagnosis_is_told_when_it_changes() -> None:
    told = Told()
    stages = ("learning", "watching", "watching", "raised", "raised", "learning", "learning")
    kinds = [told.hears(finding_of(stage)) for stage in stages]
    assert [bool(kind) for kind in kinds] == [False, True, False, True, False, True, False]
    assert told.hears(finding_of("learning"), "r2") == []
    assert told.hears(finding_of("raised"), "r2") == ["finding.changed"]
    told.journal.forgot("r2")
    assert told.hears(finding_of("raised"), "r2") == ["finding.changed"]


def test_a_verdict_is_told_when_its_status_changes() -> None:
    told = Told()
    story = [
        ("passed", []), ("corrected", []), ("fallback", ["filter.fallback_entered"]), ("fallback", []),
        ("stopped", ["filter.stopped", "filter.fallback_left"]), ("stopped", []), ("passed", ["filter.released"]),
        ("disabled", ["filter.disabled"]), ("passed", []), ("fallback", ["filter.fallback_entered"]),
        ("passed", ["filter.fallback_left"]),
    ]  # fmt: skip
    for tick, (status, kinds) in enumerate(story):
        assert told.hears(verdict_of(status, tick)) == kinds
    assert ("filter.fallback_left", "decides again after 2 ticks") in told.events
    assert ("filter.fallback_left", "decides again after 1 ticks") in told.events


@pytest.mark.parametrize(("why", "sentence"), [("", "offer"), ("by Ada's click", "by Ada's click")])
def test_a_step_of_a_change_is_told_with_its_reason(why: str, sentence: str) -> None:
    told = Told()
    told.hears(
        ModelMessage(**STAMP, step="offer", change=1, fingerprint="a", replaces="", document="", margin="", why=why)
    )
    assert [said for _, said in told.events] == [sentence]


@pytest.mark.parametrize(("wanted", "opened"), [(("*", "*"), 1), (("a", "a"), 1), (("*", "a"), 2), (("a", "b"), 2)])
def test_a_bundle_is_opened_once_for_all_who_ask_alike_and_anew_for_others(
    wanted: tuple[str, str], opened: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    keys: list[str] = []
    original = Intake.opened

    def counted(self: Intake, key: str, payload: bytes) -> Any:
        keys.append(key)
        return original(self, key, payload)

    monkeypatch.setattr(Intake, "opened", counted)
    inboxes = (Inbox(), Inbox())
    pairs = [*zip(inboxes, wanted, strict=True)]
    hearers = [Intake(inbox, STATE, "f", name, None, all_of_them=False) for inbox, name in pairs]
    _spread(hearers, f"safedpa/f/{BUNDLE}/state", packed([("a", b"1"), ("b", b"2")]))  # type: ignore[arg-type]
    assert len(keys) == opened
    for inbox, name in pairs:
        assert [key.split("/")[2] for key in inbox._latest] == (["a", "b"] if name == "*" else [name])


@pytest.mark.parametrize(("more", "by_field"), [(0, True), (1, False)])
def test_a_large_payload_that_is_no_message_is_refused_without_being_taken_apart(
    more: int, by_field: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Field by field one byte becomes an object: what is large and wrong would take the memory of many messages."""
    kind = max(LARGEST_BYTES, key=LARGEST_BYTES.__getitem__)
    assert LARGEST_BYTES[kind] > _LARGEST_BY_FIELD
    taken_apart: list[int] = []
    monkeypatch.setattr(
        msgpack,
        "unpackb",
        lambda payload, **_: taken_apart.append(len(payload)) or (_ for _ in ()).throw(ValueError("no")),
    )
    with pytest.raises(MessageError, match=kind.__name__):
        decode(kind, b"\x93" * (_LARGEST_BY_FIELD + more))
    assert bool(taken_apart) is by_field


def test_a_link_that_is_gone_is_seen_within_a_second_and_on_one_machine_signs_of_life_may_wait() -> None:
    """ms; a robot that hears nothing brakes by itself, so that longer ones would find it standing. The tests of this
    folder wait longer for busy machines: a process of its own tells what holds everywhere else."""
    script = """
from safedpa.bus import ZenohSettings
for settings in (ZenohSettings("router", ("tcp/0.0.0.0:7447",)), ZenohSettings("client", connect=("tcp/robot:7447",)),
                 ZenohSettings("peer", ("tcp/127.0.0.1:7447",))):
    words = settings.configuration()
    print(words["transport/link/tx/lease"], words["transport/unicast/accept_timeout"])
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    leases, accepts = zip(*(map(int, line.split()) for line in done.stdout.splitlines()), strict=True)
    assert all(300 <= lease <= 1000 for lease in leases[:2])
    assert 1000 <= leases[2] <= 4000
    assert all(500 <= accept <= 2000 for accept in accepts)
