"""The demonstration's story: told step by step, accepted when sure, measured; and judged over many scenes."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, field, replace
from typing import Any

import pytest

from safedpa.bus import (
    Answer,
    Bus,
    FindingMessage,
    MemoryBroker,
    MemoryTransport,
    Request,
    StateMessage,
    VerdictMessage,
)
from safedpa_lab.commands.experiments.demo import judged
from safedpa_services.supervisor.story import Story, Unsaid

STAMP = {"epoch": 1, "tick": 0, "robot_time": 0.0, "publish_time": 0.0}
STATE = StateMessage(
    **STAMP, values=(0.0, 0.0, 0.0, 1.0), applied=(0.0, 0.0), applied_by="filter", period=0.05, lockstep=False,
    goal=(1.0, 1.0), obstacles=(), field=(-4.0, 4.0, -4.0, 4.0), footprint=(0.1, 0.3, 0.2),
)  # fmt: skip


def report(error: float = 0.02, group: tuple[str, ...] = ()) -> str:
    own = {"stage": 0, "effect": "steering_offset", "heldout_error": error, "indistinguishable_from": group}
    return json.dumps({"stages": [{"heldout_error": 0.4}], "candidates": [own]})


@dataclass
class Heard:
    """What the story looks at."""

    state: StateMessage | None = None
    finding: FindingMessage | None = None
    verdict: VerdictMessage | None = None


@dataclass
class Drive:
    """A story beside a diagnosis that is played."""

    accepts: bool = True
    model: str = "aaaaaaaa"
    sentence: str = "so be it"
    asked: list[str] = field(default_factory=list)
    lines: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        broker = MemoryBroker()
        self.diagnosis = Bus(MemoryTransport(broker), "fleet")
        self.diagnosis.answer_requests(self.answer)
        self.heard = Heard()
        self.story = Story(Bus(MemoryTransport(broker), "fleet"), "r1", self.lines.append, self.accepts)

    def answer(self, _robot: str, request: Any) -> Answer:
        self.asked.append(request.do)
        if request.do == "accept":
            self.model = "bbbbbbbb"
        return Answer(
            ok=True, sentence=self.sentence, fingerprint=self.model, document=f"model {self.model}", finding=1,
            candidates=("steering_offset",),
        )  # fmt: skip

    def tell(self, t: float, stage: str, error: float, *, number: int = 1, text: str = "", model: str = "") -> None:
        stamp = STAMP | {"robot_time": t, "tick": round(20 * t)}
        self.heard.state = replace(STATE, robot_time=t, tick=round(20 * t), values=(t, 0.0, 0.0, 1.0))
        self.heard.finding = FindingMessage(
            **stamp, model=model or self.model, stage=stage, sentence=f"it is {stage}", number=number, error=error,
            band=0.06, evidence=1.0, threshold=13.8, coverage=1.0, where="yaw", report=text,
        )  # fmt: skip
        self.story.look(self.heard)

    def wait(self, until: Any) -> None:
        end = time.monotonic() + 10.0
        while not until() and time.monotonic() < end:
            time.sleep(0.005)
            self.story.look(self.heard)
        assert until()


def found(drive: Drive, text: str) -> None:
    drive.tell(1.0, "learning", 0.01, number=0)
    drive.tell(29.0, "raised", 0.3)
    drive.tell(50.0, "candidates", 0.3, text=text)


def test_the_story_is_told_accepted_and_measured():
    drive = Drive()
    found(drive, report())
    drive.wait(lambda: drive.model == "bbbbbbbb")
    drive.tell(55.0, "learning", 0.2)
    for t in range(56, 76):
        drive.tell(float(t), "learning", 0.2 if t < 65 else 0.03)
    drive.wait(lambda: drive.story.done)
    told = drive.story.document()
    assert (told["raised"], told["candidates"], told["taken"]) == (29.0, 50.0, 55.0)
    assert told["effect"] == "steering_offset"
    assert told["fall"] == pytest.approx(0.9)
    assert told["way_after"] == pytest.approx(20.0)
    assert drive.story.models == ["model aaaaaaaa", "model bbbbbbbb"]
    assert any("--yes: steering_offset is accepted; it promises 95 % less error" in line for line in drive.lines)


@pytest.mark.parametrize("text", [report(error=0.3), report(group=("understeer",))])
def test_what_is_not_sure_waits_for_one_more_search(text):
    drive = Drive()
    found(drive, text)
    drive.wait(lambda: any("one more search" in line for line in drive.lines))
    assert "accept" not in drive.asked
    drive.tell(80.0, "candidates", 0.3, text=report(error=0.021))
    drive.wait(lambda: "accept" in drive.asked)


def test_without_yes_the_person_is_told_and_nothing_is_accepted():
    drive = Drive(accepts=False)
    found(drive, report())
    drive.wait(lambda: any("your turn: accept steering_offset" in line for line in drive.lines))
    assert "accept" not in drive.asked
    drive.sentence = "change 1: dropped, the filter did not answer"
    drive.tell(60.0, "candidates", 0.3)
    drive.wait(
        lambda: any("dropped, the filter did not answer; click Accept once more" in line for line in drive.lines)
    )
    assert not drive.story.done


def test_a_change_that_was_taken_asks_for_no_other_click():
    """The diagnosis has the mended model already, its finding is on the way: accepting again would change it twice."""
    drive = Drive(accepts=False)
    found(drive, report())
    drive.wait(lambda: any("your turn: accept steering_offset" in line for line in drive.lines))
    drive.model, before = "bbbbbbbb", drive.asked.count("status")
    drive.sentence = "change 1: in force in all services"
    drive.tell(60.0, "candidates", 0.3, model="aaaaaaaa")
    drive.wait(lambda: drive.asked.count("status") > before)
    drive.story._asking.join(10.0)
    drive.story.look(drive.heard)
    assert not [line for line in drive.lines if "click Accept once more" in line]
    drive.tell(61.0, "learning", 0.2)
    assert drive.story.document()["taken"] == 61.0


def test_a_stand_without_a_word_is_counted_and_one_that_is_told_is_not():
    seen = Unsaid()
    for t in range(8):
        seen.look(replace(STATE, robot_time=float(t)), said=False)
    assert seen.longest == 7.0
    for t in range(8, 30):
        seen.look(replace(STATE, robot_time=float(t)), said=True)
    seen.look(replace(STATE, robot_time=31.0, values=(1.0, 0.0, 0.0, 1.0)), said=False)
    assert seen.longest == 7.0


def test_each_step_is_judged_by_itself():
    good = {
        "changed": 25.0, "raised": 29.0, "taken": 55.0, "fall": 0.9, "way_after": 12.0, "longest_stand_unsaid": 2.0,
        "failure": "", "seed": 1, "recording": "x", "report": "y", "picture": "",
    }  # fmt: skip
    assert judged(good)["all"]
    for change, step in (
        ({"raised": 24.0}, "found"),  # before the change: a false finding
        ({"taken": None}, "accepted"),
        ({"fall": 0.5}, "fell"),
        ({"way_after": 1.0}, "drove_on"),
        ({"longest_stand_unsaid": 11.0}, "said"),
    ):
        bad = judged(good | change)
        assert not bad[step]
        assert not bad["all"]


@pytest.mark.parametrize(
    ("model", "pending", "sentence", "told"),
    [
        ("aaaaaaaa", "", "the filter refused the change", True),
        ("aaaaaaaa", "offer", "the filter refused the change", False),
        ("bbbbbbbb", "", "change 1 is taken", False),
        ("aaaaaaaa", "", "your turn", False),
    ],
)
def test_another_click_is_asked_for_only_where_the_first_one_changed_nothing(
    model: str, pending: str, sentence: str, told: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not while a change is under way, not once it is in force, and not twice with the same words."""
    drive = Drive(accepts=False, model=model, sentence=sentence)
    drive.story._model, drive.story._told_person = "aaaaaaaa", "your turn"
    answered = drive.answer("r1", Request(do="status"))
    monkeypatch.setattr(drive.story, "_asked", lambda _: replace(answered, pending=pending))
    for _ in range(2):
        drive.story._tell_answer()
    lines = [drive.story._lines.get() for _ in range(drive.story._lines.qsize())]
    assert lines == ([f"{sentence}; click Accept once more"] if told else [])
