"""A change of the model step by step: what each message does to each state of a change, and when a load may begin."""

from __future__ import annotations

from typing import Any

import pytest
from tests.bus.test_service_loop import EPOCH, Clock

from safedpa.bus import Answer, ModelMessage, StateMessage
from safedpa.bus.loop.model_versions import ModelVersions

OLD, NEW = "0" * 12, "2" * 12


def message(step: str, change: int = 7, fingerprint: str = NEW, **more: Any) -> ModelMessage:
    given: dict[str, Any] = {
        "document": "new" if step == "offer" else "",
        "margin": "",
        "replaces": "",
        "from_tick": 0,
        "epoch": EPOCH,
    }
    stamp: dict[str, Any] = {"tick": 0, "robot_time": 0.0, "publish_time": 0.0}
    return ModelMessage(**{**given, **stamp, **more}, step=step, change=change, fingerprint=fingerprint)


class Story:
    """Versions of one robot, whose clock stands still; ``loads``: the documents that were loaded."""

    def __init__(self, state_at: Any, foretell: Any = None) -> None:
        self.loads, self.clock, self.state_at = list[str](), Clock(), state_at
        self.versions: ModelVersions[str] = ModelVersions("s", "first", OLD, self._load, foretell, clock=self.clock)

    def _load(self, _: str, offer: ModelMessage) -> str:
        self.loads.append(offer.document)
        if offer.document == "bad":
            raise ValueError("no model")
        self.clock.now += 0.01
        return offer.document

    def hear(self, *messages: ModelMessage) -> Story:
        for one in messages:
            self.versions.hear("r", one)
        return self

    def state(self, tick: int = 1, epoch: int = EPOCH, *, lockstep: bool = False) -> StateMessage:
        found: StateMessage = self.state_at(tick, epoch=epoch, lockstep=lockstep, period=0.05)
        return found

    def answers(self, *, lockstep: bool = False) -> list[tuple[str, int, str]]:
        found = []
        while (one := self.versions.answer("r", self.state(lockstep=lockstep))) is not None:
            found.append((one.state, one.change, one.reason))
        return found

    def begins(self, tick: int, epoch: int = EPOCH) -> bool:
        return self.versions.begin("r", self.state(tick, epoch))


@pytest.fixture
def story(state_at: Any) -> Story:
    return Story(state_at)


def test_nobody_who_heard_nothing_has_anything_but_the_first_model(story: Story) -> None:
    assert (story.versions.of("r"), story.versions.fingerprint("r")) == ("first", OLD)
    assert story.versions.prepared("r") is None
    assert story.versions.agreed("r") is None
    assert not story.begins(1)
    assert story.answers() == []


def test_an_offer_is_ready_and_taken_from_the_named_tick_on(story: Story) -> None:
    assert story.hear(message("offer")).answers() == [("ready", 7, "")]
    assert (story.versions.prepared("r"), story.versions.of("r")) == ("new", "first")
    assert not story.begins(9)  # nobody said when
    story.hear(message("take", from_tick=10))
    assert [story.begins(tick) for tick in (8, 9)] == [False, False]
    assert story.versions.of("r") == "first"
    assert story.begins(10)
    assert (story.versions.of("r"), story.versions.fingerprint("r")) == ("new", NEW)
    assert story.versions.prepared("r") is None
    assert not story.begins(11)
    assert story.answers() == [("taken", 7, "")]
    agreed = story.versions.agreed("r")
    assert agreed is not None
    assert (agreed.change, agreed.fingerprint, agreed.document, agreed.sentence) == (7, NEW, "new", "as s has it")


@pytest.mark.parametrize(
    ("tick", "epoch", "begins"), [(9, EPOCH, False), (10, EPOCH, True), (11, EPOCH, True), (0, EPOCH + 1, True)]
)
def test_a_robot_that_started_anew_begins_with_the_new_model(tick: int, epoch: int, begins: bool, story: Story) -> None:
    story.hear(message("offer")).answers()
    story.hear(message("take", from_tick=10))
    assert story.begins(tick, epoch) is begins
    assert story.versions.of("r") == ("new" if begins else "first")


def test_another_robot_keeps_its_model(story: Story) -> None:
    story.hear(message("offer")).answers()
    story.hear(message("take", from_tick=0))
    assert story.begins(1)
    assert (story.versions.of("r"), story.versions.of("q")) == ("new", "first")
    assert story.versions.fingerprint("q") == OLD
    story.versions.forget("r")
    assert story.versions.of("r") == "first"


@pytest.mark.parametrize(
    ("dropped", "prepared"), [(7, None), (6, "new"), (8, "new")], ids=["this change", "a former one", "a later one"]
)
def test_a_drop_ends_the_change_that_it_names_and_no_other(dropped: int, prepared: str | None, story: Story) -> None:
    story.hear(message("offer")).answers()
    story.hear(message("drop", dropped, ""))
    assert story.versions.prepared("r") == prepared


@pytest.mark.parametrize(("dropped", "loads"), [(7, []), (6, ["new"]), (8, ["new"])])
def test_an_offer_that_was_dropped_before_its_turn_is_never_loaded(
    dropped: int, loads: list[str], story: Story
) -> None:
    story.hear(message("offer"), message("drop", dropped, ""))
    assert story.answers() == [("ready", 7, "")] * len(loads)
    assert story.loads == loads


def test_a_drop_where_nothing_is_under_way_does_nothing(story: Story) -> None:
    assert story.hear(message("drop")).answers() == []
    assert story.versions.of("r") == "first"


def test_what_is_to_be_taken_is_not_dropped_any_more(story: Story) -> None:
    """The others may be using it already."""
    story.hear(message("offer")).answers()
    story.hear(message("take", from_tick=10), message("drop", 7, ""))
    assert story.begins(10)
    assert story.versions.of("r") == "new"


@pytest.mark.parametrize(
    ("change", "fingerprint", "answers"),
    [
        (7, NEW, []),
        (8, NEW, [("refused", 8, "it was not offered before, or not to this process")]),
        (7, "3" * 12, [("refused", 7, "it was not offered before, or not to this process")]),
    ],
)
def test_only_what_was_offered_is_taken(
    change: int, fingerprint: str, answers: list[tuple[str, int, str]], story: Story
) -> None:
    story.hear(message("offer")).answers()
    assert story.hear(message("take", change, fingerprint)).answers() == answers
    assert story.begins(1) is not bool(answers)


def test_an_offer_and_a_take_that_are_told_twice_are_answered_twice_and_loaded_once(story: Story) -> None:
    assert story.hear(message("offer")).answers() == [("ready", 7, "")]
    assert story.hear(message("offer")).answers() == [("ready", 7, "")]
    assert story.hear(message("take"), message("take")).begins(1)
    assert story.answers() == [("taken", 7, "")]
    assert story.hear(message("take")).answers() == [("taken", 7, "")]
    assert story.hear(message("offer")).answers() == [("taken", 7, "")]
    assert story.loads == ["new"]


def test_a_newer_offer_displaces_what_was_prepared_and_its_take(story: Story) -> None:
    story.hear(message("offer")).answers()
    story.hear(message("take", from_tick=10), message("offer", 8, "3" * 12, document="newer"))
    assert story.versions.prepared("r") is None
    assert not story.begins(10)
    assert story.answers() == [("ready", 8, "")]
    assert story.versions.prepared("r") == "newer"
    assert not story.begins(11)


def test_what_cannot_be_used_is_refused_and_nothing_prepared(story: Story) -> None:
    assert story.hear(message("offer", document="bad")).answers() == [("refused", 7, "no model")]
    assert story.versions.prepared("r") is None
    assert story.hear(message("take")).answers()[0][0] == "refused"
    assert not story.begins(1)


def test_an_offer_of_the_model_in_force_needs_no_load_and_changes_nothing(story: Story) -> None:
    """The first one again: only the change gets its number."""
    assert story.hear(message("offer", 7, OLD, document="old")).answers() == [("ready", 7, "")]
    assert story.loads == []
    story.hear(message("take", 7, OLD))
    assert not story.begins(1)
    assert (story.versions.of("r"), story.answers()) == ("first", [("taken", 7, "")])
    agreed = story.versions.agreed("r")
    assert agreed is not None
    assert (agreed.change, agreed.document) == (7, "old")


def test_of_another_margin_the_same_model_is_another_version(story: Story) -> None:
    story.hear(message("offer", 7, OLD, document="old", margin="wider")).answers()
    assert story.loads == ["old"]


def test_what_a_change_will_do_is_told_before_it_is_taken(state_at: Any) -> None:
    story = Story(state_at, lambda robot, held: f"{robot} {held} {'x' * 400}")
    story.hear(message("offer"))
    answer = story.versions.answer("r", story.state())
    assert answer is not None
    assert answer.foretold == f"r new {'x' * 294}"
    assert answer.reason == ""


class Ticket:
    def __init__(self, *outcomes: dict[str, object] | None) -> None:
        self.outcomes, self.waits = list(outcomes), list[bool]()

    def outcome(self, *, wait: bool) -> dict[str, object] | None:
        self.waits.append(wait)
        return self.outcomes.pop(0) if self.outcomes else None


def trial(*outcomes: dict[str, object] | None) -> Any:
    return Ticket(*outcomes)


def test_an_offer_is_tried_elsewhere_once_and_loaded_as_the_trial_left_it(story: Story) -> None:
    ticket, handed = trial(None, {"document": "plain"}), list[str]()

    def hand_in(robot: str, offer: ModelMessage) -> Any:
        handed.append(f"{robot} {offer.document}")
        return ticket

    story.versions.hand_in = hand_in
    story.hear(message("offer"))
    assert story.answers() == []
    assert story.loads == []
    assert story.answers() == [("ready", 7, "")]
    assert (handed, story.loads, ticket.waits) == (["r new"], ["plain"], [False, False])


@pytest.mark.parametrize("problem", ["it has no weights", "x" * 400])
def test_what_failed_its_trial_is_refused_and_never_loaded(problem: str, story: Story) -> None:
    story.versions.hand_in = lambda *_: trial({"problem": problem})
    assert story.hear(message("offer")).answers() == [("refused", 7, problem[:300])]
    assert story.loads == []
    assert story.versions.prepared("r") is None


@pytest.mark.parametrize("longer", [0, 1])
@pytest.mark.parametrize("part", ["document", "margin"])
def test_what_is_longer_than_the_limit_is_not_even_tried(
    part: str, longer: int, story: Story, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SAFEDPA_LIMITS", "offer_bytes=10")
    story.versions.hand_in = lambda *_: trial({})
    (answer,) = story.hear(message("offer", 7, NEW, **{part: "x" * (10 + longer)})).answers()
    assert answer[0] == ("refused" if longer else "ready")
    assert ("got 11 letters, wanted at most 10" in answer[2]) == bool(longer)


def test_the_model_in_force_is_tried_nowhere(story: Story) -> None:
    story.versions.hand_in = lambda *_: pytest.fail("tried")
    assert story.hear(message("offer", 7, OLD)).answers() == [("ready", 7, "")]


@pytest.mark.parametrize(
    ("lockstep", "after", "answered"), [(False, 0.0, 0), (False, 0.009, 0), (False, 0.0101, 1), (True, 0.0, 1)]
)
def test_after_a_load_the_loop_has_as_long_for_others(
    lockstep: bool, after: float, answered: int, story: Story
) -> None:
    """A load takes 0.01 s here; in lockstep nobody waits for a moment."""
    story.versions.hand_in = lambda *_: trial({})
    story.hear(message("offer")).answers()
    assert story.loads == ["new"]
    story.clock.now += after
    story.versions.hear("q", message("offer", 8, "3" * 12, document="other"))
    answer = story.versions.answer("q", story.state(lockstep=lockstep))
    assert (answer is not None) == bool(answered)
    assert story.loads == ["new", "other"][: 1 + answered]


def status(**more: Any) -> Answer:
    given: dict[str, Any] = {
        "ok": True,
        "sentence": "",
        "fingerprint": "4" * 12,
        "change": 5,
        "document": "agreed",
        "epoch": EPOCH,
    }
    return Answer(**{**given, **more})


PENDING: dict[str, Any] = {"pending_document": "new", "pending_fingerprint": NEW, "from_tick": 10}


@pytest.mark.parametrize("answer", [None, status(ok=False), status(fingerprint="")], ids=["none", "not ok", "no model"])
def test_an_answer_that_says_nothing_changes_nothing(answer: Answer | None, story: Story) -> None:
    story.versions.welcome("r", answer)
    assert (story.versions.of("r"), story.loads) == ("first", [])


def test_without_a_document_the_first_model_stays(story: Story) -> None:
    story.versions.welcome("r", status(document=""))
    assert (story.versions.of("r"), story.loads) == ("first", [])


@pytest.mark.parametrize(
    ("more", "change"),
    [
        ({}, 5),
        ({"pending": "offer", **PENDING}, 0),
        ({"pending": "take", **PENDING}, 0),
        ({"pending": "take", **PENDING, "pending_fingerprint": "4" * 12}, 5),
    ],
    ids=["nothing under way", "offered", "to be taken", "taken, and still told"],
)
def test_what_is_in_force_has_the_number_of_the_change_that_is_over(
    more: dict[str, Any], change: int, story: Story
) -> None:
    """While another one is under way that number is the other one's."""
    story.versions.welcome("r", status(**more))
    agreed = story.versions.agreed("r")
    assert agreed is not None
    assert (agreed.change, agreed.fingerprint, agreed.document) == (change, "4" * 12, "agreed")
    assert story.versions.of("r") == "agreed"


def test_who_is_welcomed_while_a_change_is_to_be_taken_takes_it_with_the_others(story: Story) -> None:
    story.versions.welcome("r", status(pending="take", **PENDING))
    assert story.loads == ["agreed", "new"]
    assert not story.begins(9)
    assert story.begins(10)
    assert story.versions.of("r") == "new"


def test_an_agreed_model_that_cannot_be_used_is_refused_and_the_first_one_serves(story: Story) -> None:
    story.versions.welcome("r", status(document="bad"))
    assert story.versions.of("r") == "first"
    assert story.answers() == [("refused", 5, "no model")]


@pytest.mark.parametrize("ready", [False, True])
def test_an_offer_that_came_before_the_answer_is_the_newer_one(ready: bool, story: Story) -> None:
    story.hear(message("offer", 8, "3" * 12, document="newest"))
    if ready:
        story.answers()
    story.versions.welcome("r", status(pending="take", **PENDING))
    story.answers()
    assert story.versions.prepared("r") == "newest"
    assert not story.begins(10)
