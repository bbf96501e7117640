"""How long somebody is believed, waited for or told of, by a clock that the test moves."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from safedpa.bus import STATE, VERDICT, Answer, Received
from safedpa.bus.loop.greeting import Greeting
from safedpa.bus.wire.topics import MODEL
from safedpa.errors import SafedpaError
from safedpa_services.command_line import change_requests
from safedpa_services.ros_gateway.overheard import Overheard
from safedpa_services.supervisor import warnings
from safedpa_services.supervisor.warnings import Warnings


@pytest.mark.parametrize(("later", "told"), [(0.0, True), (0.99, True), (1.01, False), (5.0, False)])
def test_who_speaks_on_the_topic_of_commands_is_told_for_a_second(later: float, told: bool) -> None:
    now = [100.0]
    overheard = Overheard("/cmd_vel", lambda: now[0])
    assert overheard.why == ""
    overheard.take(b"")
    now[0] += later
    assert ("publishes on /cmd_vel too" in overheard.why) is told


def test_whoever_floods_the_topic_is_answered_a_thousand_times_a_second_at_most() -> None:
    now, answers = [100.0], list[float]()
    overheard = Overheard("/cmd_vel", lambda: now[0])
    overheard.answer = lambda: answers.append(now[0])
    for tenth in range(1000):
        now[0] = 100.0 + 0.0001 * tenth
        overheard.take(b"")
    assert 90 <= len(answers) <= 101
    assert answers[0] == 100.0, "the first one at once"


class Telling:
    """A child with a log."""

    name, restarts, pid = "policy", 0, 7

    def __init__(self, log: Path) -> None:
        self.log = log

    def warn(self, kind: str) -> None:
        event = {"time": 1.0, "level": "warning", "kind": kind, "sentence": f"{kind} happened", "service": "policy"}
        with self.log.open("a", encoding="utf-8") as file:
            file.write(json.dumps(event) + "\n")


def test_a_warning_is_shown_within_half_a_second_and_its_like_five_seconds_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now, told = [100.0], list[tuple[float, str]]()
    monkeypatch.setattr(warnings.time, "monotonic", lambda: now[0])
    child: Any = Telling(tmp_path / "policy.log")
    shown = Warnings((child,), tmp_path, lambda line: told.append((round(now[0] - 100.0, 2), line)))
    for twentieth in range(240):
        now[0] = 100.0 + 0.05 * twentieth
        child.warn("flood")
        if twentieth == 43:
            child.warn("once")
        shown.look()
    moments = {kind: [at for at, line in told if kind in line] for kind in ("flood", "once")}
    first, second, third = moments["flood"]
    assert first <= 0.5
    assert second - first == pytest.approx(5.0, abs=0.5)
    assert third - second == pytest.approx(5.0, abs=0.5)
    assert len(moments["once"]) == 1
    assert 2.15 <= moments["once"][0] <= 2.7


@pytest.mark.parametrize(
    ("answers_until", "over_at", "ends_at"), [(99.0, 3.0, 3.0), (1.0, 99.0, 11.0), (999.0, 999.0, 120.0)]
)
def test_the_end_of_a_change_is_waited_for_two_minutes_and_a_silent_diagnosis_ten_seconds(
    answers_until: float, over_at: float, ends_at: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who looks ten times a second sees the end as it comes."""
    now = [0.0]

    def sleep(seconds: float) -> None:
        assert seconds <= 0.2, "a person waits"
        now[0] += seconds

    def request(_robot: str, _request: Any, patience: float) -> Answer | None:
        if now[0] > answers_until:
            now[0] += patience
            return None
        return Answer(ok=True, sentence="so", change=4, pending="" if now[0] >= over_at else "take")

    monkeypatch.setattr(change_requests, "time", SimpleNamespace(monotonic=lambda: now[0], sleep=sleep))
    bus: Any = SimpleNamespace(request=request, fleet="f")
    begun = Answer(ok=True, sentence="change 4 begins", change=4)
    if over_at < 99.0:
        assert change_requests._end_of(bus, "r1", begun).pending == ""
    else:
        with pytest.raises(
            SafedpaError, match="is not over after 120 s" if answers_until > 99.0 else "no diagnosis answers"
        ):
            change_requests._end_of(bus, "r1", begun)
    assert now[0] == pytest.approx(ends_at, abs=2.2)


class Asked:
    """A node that asks for the model of whoever it meets, and the bus on which it does."""

    name, listens = "policy", (MODEL,)

    def __init__(self) -> None:
        self.welcomed: list[tuple[str, Answer | None]] = []
        self.questions: list[tuple[str, float]] = []
        self.answers: list[Any] = []

    def agreed(self, _robot: str) -> None:
        return None

    def welcome(self, robot: str, answer: Answer | None) -> None:
        self.welcomed.append((robot, answer))

    def answer_agreed(self, _agreed: Any) -> None:
        return None

    def ask_model(self, _inbox: Any, robot: str, _service: str, patience: float) -> None:
        self.questions.append((robot, patience))

    def take_answers(self) -> list[Any]:
        taken, self.answers = self.answers, []
        return taken


def said(topic: Any, number: int, robot: str = "r1") -> Received:
    message: Any = SimpleNamespace(number=number)
    return Received(topic, robot, message, b"", f"safedpa/f/{robot}/{topic.name}", 0.0)


@pytest.mark.parametrize("answered", [False, True])
def test_what_a_robot_says_waits_for_its_model_and_for_no_more_than_a_second(answered: bool) -> None:
    """The newest of each topic comes then, the state first; two are asked, one after the other, and each in vain."""
    now, everything = [100.0], Asked()
    own: Any = everything
    greeting_of = Greeting(own, own, own, lambda: now[0], lambda *_: None)
    assert not greeting_of.holds(said(VERDICT, 0)), "before its first state nobody is met"
    for number in (1, 2):
        assert greeting_of.holds(said(STATE, number))
        assert greeting_of.holds(said(VERDICT, number))
    assert [robot for robot, _ in everything.questions] == ["r1"]
    patience = everything.questions[0][1]
    assert 2.0 * patience < greeting_of.deadline() - now[0] <= 1.0
    assert greeting_of.ready() == []
    told = Answer(ok=True, sentence="as the diagnosis has it")
    if answered:
        everything.answers = [SimpleNamespace(robot="r1", answer=told)]
    else:
        now[0] = greeting_of.deadline()
    served: list[Any] = greeting_of.ready()
    assert [(item.topic, item.message.number) for item in served] == [(STATE, 2), (VERDICT, 2)]
    assert everything.welcomed == [("r1", told if answered else None)]
    assert greeting_of.deadline() == float("inf")
    assert not greeting_of.holds(said(STATE, 3))
    greeting_of.forget("r1")
    assert greeting_of.holds(said(STATE, 4)), "it is asked for again when it returns"
