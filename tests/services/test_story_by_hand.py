"""What the demonstration counts and when it accepts: each condition alone, without waiting for any thread."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
from tests.services.test_demo_story import STAMP, STATE

from safedpa.bus import Answer, Bus, FindingMessage, MemoryBroker, MemoryTransport, Request
from safedpa.errors import SafedpaError
from safedpa_services.supervisor.story import Story, _promise


class Told(Story):
    """A story that asks at once instead of on a thread, and a diagnosis that answers ``answer``."""

    answer = Answer(ok=True, sentence="so be it", fingerprint="a" * 8, document="d", finding=1, candidates=("drag",))

    def _beside(self, do: Callable[[], None]) -> None:
        do()

    def _asked(self, request: Request) -> Answer:
        del request
        return self.answer


def story_of(*, accepts: bool = True) -> tuple[Told, list[str]]:
    lines: list[str] = []
    return Told(Bus(MemoryTransport(MemoryBroker()), "fleet"), "r1", lines.append, accepts), lines


def finding_of(t: float, model: str = "a" * 8, *, stage: str = "watching", number: int = 0, **more: Any) -> Any:
    what = {"error": 0.1, "band": 0.06, "evidence": 1.0, "threshold": 13.8, "coverage": 1.0, "where": "yaw", **more}
    stamp = STAMP | {"robot_time": t}
    return FindingMessage(**stamp, model=model, stage=stage, sentence=f"it is {stage}", number=number, **what)


def heard(t: float | None, x: float = 0.0, finding: Any = None, standstill: str | None = None) -> Any:
    """State, finding and verdict as a watch has them; ``t`` None: no state yet, ``standstill`` None: no verdict."""
    state = None if t is None else replace(STATE, robot_time=t, values=(x, 0.0, 0.0, 0.0))
    verdict = None if standstill is None else SimpleNamespace(standstill=standstill)
    return SimpleNamespace(state=state, finding=finding, verdict=verdict)


@pytest.mark.parametrize(("standstill", "unsaid"), [(None, 9.0), ("", 9.0), ("the wall is near", 0.0)])
def test_a_stand_is_said_where_the_verdict_tells_of_it_and_not_by_any_verdict(
    standstill: str | None, unsaid: float
) -> None:
    story, _ = story_of()
    for t in range(10):
        story.look(heard(float(t), standstill=standstill))
    assert story.document()["longest_stand_unsaid"] == unsaid


@pytest.mark.parametrize("late", [False, True])
def test_the_way_counts_from_the_change_of_the_model_on(late: bool) -> None:
    """From the first place that is known then, be it that no state was heard before it."""
    story, lines = story_of()
    story.look(heard(None if late else 0.0, 1.0, finding_of(0.0)))
    story.look(heard(None if late else 1.0, 5.0, finding_of(1.0, "b" * 8)))
    assert story.told.taken == 1.0
    assert len([line for line in lines if "bbbbbbbb is in force instead of aaaaaaaa" in line]) == 1
    for t, x in ((2.0, 7.0), (3.0, 8.0), (4.0, 6.0)):
        story.look(heard(t, x))
    assert story.told.way_after == pytest.approx(3.0 if late else 5.0)


def report(error: float, group: tuple[str, ...] = ()) -> str:
    own = {"stage": 0, "effect": "drag", "heldout_error": error, "indistinguishable_from": group}
    return json.dumps({"stages": [{"heldout_error": 0.4}], "candidates": [own]})


@pytest.mark.parametrize(
    ("error", "group", "accepted_after"),
    [(0.1, (), 1), (0.15, (), 1), (0.17, (), None), (0.1, ("tow",), 2), (0.3, ("tow",), None)],
)
def test_what_promises_sixty_percent_is_accepted_and_at_the_second_search_whatever_it_is_like(
    error: float, group: tuple[str, ...], accepted_after: int | None
) -> None:
    """Of an error of 0.4 before: 0.16 is the most that may be left on unseen data."""
    story, _ = story_of()
    story.look(heard(0.0, 0.0, finding_of(0.0)))
    searches = None
    for search in (1, 2, 3):
        text = report(error + 1e-6 * search, group)  # of other data each time
        story._hear(finding_of(10.0 * search, stage="candidates", number=1, report=text))
        if story._wish and searches is None:
            searches = search
    assert searches == accepted_after
    assert story.told.effect == "drag"


def test_an_effect_promises_what_the_entry_does_that_was_accepted() -> None:
    """Tried under a condition it has the name of the one without."""
    document = json.loads(report(0.1))
    own = document["candidates"][0] | {"decision": "accepted"}
    document["candidates"] = [
        own | {"decision": "rejected", "heldout_error": 0.05, "indistinguishable_from": ["x"]},
        own,
    ]
    assert _promise(json.dumps(document), "drag") == (pytest.approx(0.75), ())
    assert _promise(json.dumps(document), "tow") == (0.0, ())


@pytest.mark.parametrize(
    ("pending", "candidates", "accepts"), [("", ("drag",), True), ("take", ("drag",), False), ("", ("tow",), False)]
)
def test_only_what_is_a_candidate_now_is_accepted_and_nothing_amid_a_change(
    pending: str, candidates: tuple[str, ...], accepts: bool
) -> None:
    story, asked = story_of()[0], list[str]()
    given = replace(story.answer, pending=pending, candidates=candidates)

    def answered(request: Request) -> Answer:
        asked.append(request.do)
        return given

    story._asked = answered  # type: ignore[method-assign]
    story._accept("drag")
    assert asked == (["status", "accept"] if accepts else ["status"])


def test_the_diagnosis_has_seconds_to_answer_and_that_it_did_not_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever looks on reads why nothing goes on."""
    waited: list[float] = []
    story = Story(Bus(MemoryTransport(MemoryBroker()), "fleet"), "r1", lambda _: None, True)

    def request(_: str, __: Request, seconds: float) -> None:
        waited.append(seconds)

    monkeypatch.setattr(story.bus, "request", request)
    with pytest.raises(SafedpaError, match="the diagnosis did not answer in time; it is asked again"):
        story._keep_model()
    assert 1.0 <= waited[0] <= 4.0
    assert story.models == []
