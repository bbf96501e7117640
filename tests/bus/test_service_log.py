"""A service's journal: only changes are written, with their reasons."""

import dataclasses
from typing import Any

import pytest

from safedpa.bus import STATE, Message
from safedpa.bus.service.service_log import ServiceLog


class Book:
    """A journal, and the events that it wrote."""

    def __init__(self) -> None:
        self.events: list[tuple[str, str]] = []
        self.levels: list[str] = []
        self.service_log = ServiceLog("policy", self.log)

    def log(self, kind: str, sentence: str, *, level: str, service: str, **_: Any) -> None:
        assert service == "policy"
        self.events.append((kind, sentence))
        self.levels.append(level)

    def written_of(self, message: Message, robot: str = "r1", **changes: Any) -> list[str]:
        before = len(self.events)
        self.service_log.notice(robot, {STATE: dataclasses.replace(message, **changes)})
        return [kind for kind, _ in self.events[before:]]


@pytest.fixture
def book() -> Book:
    return Book()


def test_a_stage_of_the_diagnosis_is_written_when_it_changes(book: Book, samples: dict[str, Message]) -> None:
    stages = ("learning", "watching", "watching", "raised", "raised", "learning", "learning")
    written = [book.written_of(samples["finding"], stage=stage) for stage in stages]
    assert [bool(kinds) for kinds in written] == [False, True, False, True, False, True, False]
    assert book.levels == ["info", "warning", "info"]
    assert book.written_of(samples["finding"], "r2", stage="learning") == []
    assert book.written_of(samples["finding"], "r2", stage="raised") == ["finding.changed"]
    book.service_log.forgot("r2")
    assert book.written_of(samples["finding"], "r2", stage="raised") == ["finding.changed"]


def test_a_verdict_is_written_when_its_status_changes(book: Book, samples: dict[str, Message]) -> None:
    story = [
        ("passed", []), ("corrected", []), ("fallback", ["filter.fallback_entered"]), ("fallback", []),
        ("stopped", ["filter.stopped", "filter.fallback_left"]), ("stopped", []), ("passed", ["filter.released"]),
        ("disabled", ["filter.disabled"]), ("passed", []), ("fallback", ["filter.fallback_entered"]),
        ("passed", ["filter.fallback_left"]),
    ]  # fmt: skip
    for tick, (status, kinds) in enumerate(story):
        assert book.written_of(samples["verdict"], status=status, tick=tick, sentence=f"it is {status}") == kinds
    lasted = [sentence for kind, sentence in book.events if kind == "filter.fallback_left"]
    assert lasted == ["decides again after 2 ticks", "decides again after 1 ticks"]
    assert [level for (kind, _), level in zip(book.events, book.levels, strict=True) if "fallback_entered" in kind] == [
        "warning"
    ] * 2


@pytest.mark.parametrize(
    ("topic", "changes", "event", "level"),
    [
        ("model", {"step": "offer", "why": ""}, ("model.offered", "offer"), "info"),
        ("model", {"step": "take", "why": "Ada's click"}, ("model.decided", "Ada's click"), "info"),
        ("model", {"step": "drop", "why": "it is late"}, ("model.dropped", "it is late"), "warning"),
        (
            "takeover",
            {"state": "ready", "reason": "", "fingerprint": "m"},
            ("model.ready", "model m is ready"),
            "info",
        ),
        (
            "takeover",
            {"state": "taken", "reason": "", "fingerprint": "m"},
            ("model.taken", "model m is taken"),
            "info",
        ),
        ("takeover", {"state": "refused", "reason": "no weights"}, ("model.refused", "no weights"), "warning"),
    ],
)
def test_a_step_of_a_change_is_written_with_its_reason(topic, changes, event, level, book, samples):
    book.written_of(samples[topic], **changes)
    assert (book.events, book.levels) == ([event], [level])
