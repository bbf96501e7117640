"""A change of the model step by step: the effect of each message on each state of a change."""

import dataclasses
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as some
from tests.bus.fleet import EPOCH, Clock, StateAt, stamp

from safedpa.bus import Answer, ModelMessage, StateMessage
from safedpa.bus.service.model_versions import ModelVersions

OLD, NEW, THIRD = "0" * 12, "2" * 12, "3" * 12


def message(step: str, change: int = 7, fingerprint: str = NEW, **more: Any) -> ModelMessage:
    given: dict[str, Any] = {"document": "new" if step == "offer" else "", "replaces": "", **stamp(), **more}
    return ModelMessage(**given, step=step, change=change, fingerprint=fingerprint)


class Story:
    """Versions of the robot ``r``; ``loads`` are the documents that were loaded, each in 0.01 s."""

    def __init__(self, state: StateMessage, predict_effect: Any = None) -> None:
        self.state, self.loads, self.clock = state, list[str](), Clock()
        self.versions = ModelVersions[str]("s", "first", OLD, self.load, predict_effect, clock=self.clock)

    def load(self, _: str, offer: ModelMessage) -> str:
        self.loads.append(offer.document)
        if offer.document.startswith("bad"):
            raise {"bad": ValueError("no\n  model"), "bad key": KeyError()}[offer.document]
        self.clock.now += 0.01
        return offer.document

    def at(self, tick: int = 1, epoch: int = EPOCH, *, lockstep: bool = False) -> StateMessage:
        return dataclasses.replace(self.state, tick=tick, epoch=epoch, lockstep=lockstep, period=0.05)

    def answers(self, **of_the_state: Any) -> list[tuple[str, int, str]]:
        found = []
        while (one := self.versions.answer("r", self.at(**of_the_state))) is not None:
            found.append((one.state, one.change, one.reason))
        return found

    def play(self, *steps: Any) -> list[tuple[str, int, str]]:
        """The answers to messages, to several of them at once (a list), and to states of ticks or (tick, epoch)."""
        found = []
        for step in steps:
            if isinstance(step, int | tuple):
                self.versions.begin("r", self.at(*(step if isinstance(step, tuple) else (step,))))
            for one in step if isinstance(step, list) else [step] if isinstance(step, ModelMessage) else []:
                self.versions.hear("r", one)
            found += self.answers()
        return found


@pytest.fixture
def story(state_at: StateAt) -> Story:
    return Story(state_at(1))


OFFER, TAKE, DROP = message("offer"), message("take", from_tick=10), message("drop")
NEWER = message("offer", 8, THIRD, document="newer")
READY, TAKEN, UNKNOWN = ("ready", 7, ""), ("taken", 7, ""), "this process did not receive the offer"

STORIES: dict[str, tuple[list[Any], str, str | None, list[tuple[str, int, str]], list[str]]] = {
    # messages and ticks: model in force, prepared model, answers, documents loaded
    "without a message the first model stays": ([1], "first", None, [], []),
    "an offer is loaded and waits": ([OFFER, 99], "first", "new", [READY], ["new"]),
    "a take waits for its tick": ([OFFER, TAKE, 9], "first", "new", [READY], ["new"]),
    "a take is in force from its tick on": ([OFFER, TAKE, 9, 10], "new", None, [READY, TAKEN], ["new"]),
    "a take is in force at a later tick": ([OFFER, TAKE, 11], "new", None, [READY, TAKEN], ["new"]),
    "a restarted robot begins with the new model": (
        [OFFER, TAKE, (0, EPOCH + 1)], "new", None, [READY, TAKEN], ["new"],
    ),
    "a drop ends its change": ([OFFER, DROP, TAKE, 10], "first", None, [READY, ("refused", 7, UNKNOWN)], ["new"]),
    "a drop of a former change ends nothing": ([OFFER, message("drop", 6)], "first", "new", [READY], ["new"]),
    "a drop of a later change ends nothing": ([OFFER, message("drop", 8)], "first", "new", [READY], ["new"]),
    "an offer that was dropped in time is never loaded": ([[OFFER, DROP]], "first", None, [], []),
    "another drop in time spares the offer": ([[OFFER, message("drop", 8)]], "first", "new", [READY], ["new"]),
    "a drop without an offer does nothing": ([DROP], "first", None, [], []),
    "a change that is to be taken is not dropped: others may use it": (
        [OFFER, TAKE, DROP, 10], "new", None, [READY, TAKEN], ["new"],
    ),
    "a take of another change is refused": (
        [OFFER, message("take", 8), 1], "first", "new", [READY, ("refused", 8, UNKNOWN)], ["new"],
    ),
    "a take of another model is refused": (
        [OFFER, message("take", 7, THIRD), 1], "first", "new", [READY, ("refused", 7, UNKNOWN)], ["new"],
    ),
    "repeated messages are answered again and loaded once": (
        [OFFER, OFFER, [TAKE, TAKE], 10, TAKE, OFFER], "new", None, [READY] * 2 + [TAKEN] * 3, ["new"],
    ),
    "a newer offer replaces what was prepared, and its take": (
        [OFFER, [TAKE, NEWER], 10], "first", "newer", [READY, ("ready", 8, "")], ["new", "newer"],
    ),
    "a model that cannot be loaded is refused in one line": (
        [message("offer", document="bad"), TAKE, 10], "first", None,
        [("refused", 7, "no model"), ("refused", 7, UNKNOWN)], ["bad"],
    ),
    "an error without words is named": (
        [message("offer", document="bad key")], "first", None, [("refused", 7, "KeyError")], ["bad key"],
    ),
    "the model in force is not loaded again": (
        [message("offer", 7, OLD, document="old"), message("take", 7, OLD), 1], "first", None, [READY, TAKEN], [],
    ),
    "the model in force with another margin is loaded": (
        [message("offer", 7, OLD, document="old", margin="wider")], "first", "old", [READY], ["old"],
    ),
}  # fmt: skip


@pytest.mark.parametrize(("steps", "in_force", "prepared", "answers", "loads"), STORIES.values(), ids=list(STORIES))
def test_each_message_takes_a_change_one_step_on(steps, in_force, prepared, answers, loads, story):
    assert story.play(*steps) == answers
    assert (story.versions.of("r"), story.versions.prepared("r")) == (in_force, prepared)
    assert story.versions.fingerprint("r") == (NEW if in_force == "new" else OLD)
    assert story.loads == loads
    assert (story.versions.of("q"), story.versions.fingerprint("q")) == ("first", OLD), "another robot's is unchanged"
    story.versions.forget("r")
    assert story.versions.of("r") == "first"


messages = some.builds(
    message, some.sampled_from(["offer", "take", "drop"]), some.integers(1, 2), some.sampled_from([OLD, NEW, THIRD]),
    from_tick=some.integers(0, 6), document=some.sampled_from(["a", "b", "bad"]),
)  # fmt: skip


@given(sent=some.lists(messages, max_size=12))
def test_a_model_comes_into_force_only_by_a_take_of_what_was_ready(sent, samples):
    story, ready, takes = Story(samples["state"]), {(0, OLD)}, list[tuple[int, str]]()
    for tick, one in enumerate(sent):
        before = story.versions.fingerprint("r")
        changed = story.versions.begin("r", story.at(tick))
        now = story.versions.fingerprint("r")
        if changed or now != before:
            assert any(fingerprint == now and at <= tick for at, fingerprint in takes)
            assert now in {fingerprint for _, fingerprint in ready}
        story.versions.hear("r", one)
        if one.step == "take":
            takes.append((one.from_tick, one.fingerprint))
        ready |= {(change, one.fingerprint) for state, change, _ in story.answers() if state == "ready"}


def test_begin_says_whether_the_model_changed(story: Story) -> None:
    story.play(OFFER, TAKE)
    assert [story.versions.begin("r", story.at(tick)) for tick in (9, 10, 11)] == [False, True, False]
    story.play(message("offer", 8, OLD, document="old"))


def test_the_services_of_a_robot_can_ask_each_other_for_the_model_that_was_agreed_on(story: Story) -> None:
    assert story.versions.agreed("r") is None
    story.play(message("offer", margin="wide"), TAKE, 10)
    agreed = story.versions.agreed("r")
    assert agreed == Answer(ok=True, sentence="as s has it", change=7, fingerprint=NEW, document="new", margin="wide")


def test_what_a_change_will_do_is_reported_before_it_is_taken(state_at: StateAt) -> None:
    story = Story(state_at(1), lambda robot, held: f"{robot} {held} {'x' * 400}")
    story.versions.hear("r", OFFER)
    answer = story.versions.answer("r", story.at())
    assert answer is not None
    assert (answer.expected_effect, answer.reason) == (f"r new {'x' * 294}", "")


class Ticket:
    """A trial in another process, with its outcomes one after the other."""

    def __init__(self, *outcomes: dict[str, object] | None) -> None:
        self.outcomes, self.waits = list(outcomes), list[bool]()

    def outcome(self, *, wait: bool) -> dict[str, object] | None:
        self.waits.append(wait)
        return self.outcomes.pop(0) if self.outcomes else None


def tried(story: Story, *outcomes: dict[str, object] | None) -> Ticket:
    ticket: Any = Ticket(*outcomes)
    story.versions.submit = lambda *_: ticket
    return ticket


def test_an_offer_is_tried_in_another_process_and_loaded_as_the_trial_left_it(story: Story) -> None:
    ticket = tried(story, None, {"document": "plain"})
    assert (story.play(OFFER), story.loads) == ([], [])
    assert (story.answers(), story.loads) == ([READY], ["plain"])
    assert ticket.waits == [False, False]


@pytest.mark.parametrize("problem", ["it has no weights", "x" * 400])
def test_an_offer_that_fails_its_trial_is_refused_and_never_loaded(problem: str, story: Story) -> None:
    tried(story, {"problem": problem})
    assert story.play(OFFER) == [("refused", 7, problem[:300])]
    assert (story.loads, story.versions.prepared("r")) == ([], None)


@pytest.mark.parametrize("longer", [0, 1])
@pytest.mark.parametrize("part", ["document", "margin"])
def test_an_offer_that_is_longer_than_the_limit_is_not_even_tried(part, longer, story, monkeypatch):
    monkeypatch.setenv("SAFEDPA_LIMITS", "offer_bytes=10")
    ticket = tried(story, {})
    ((state, _, reason),) = story.play(message("offer", **{part: "x" * (10 + longer)}))
    assert (state, len(ticket.waits)) == (("refused", 0) if longer else ("ready", 1))
    assert ("got 11 characters, wanted at most 10" in reason) == bool(longer)


def test_the_model_in_force_needs_no_trial(story: Story) -> None:
    story.versions.submit = lambda *_: pytest.fail("tried")
    assert story.play(message("offer", 7, OLD)) == [READY]


@pytest.mark.parametrize(
    ("lockstep", "after", "answered"), [(False, 0.0, 0), (False, 0.009, 0), (False, 0.0101, 1), (True, 0.0, 1)]
)
def test_after_a_load_the_loop_has_as_long_for_other_work(lockstep: bool, after: float, answered: int, story: Story):
    """In lockstep the robot waits, and so may the loop."""
    tried(story, {}, {})
    story.play(OFFER)
    story.clock.now += after
    story.versions.hear("q", message("offer", 8, THIRD, document="other"))
    answer = story.versions.answer("q", story.at(lockstep=lockstep))
    assert (answer is not None) == bool(answered)
    assert story.loads == ["new", "other"][: 1 + answered]


AGREED: dict[str, Any] = {"fingerprint": "4" * 12, "change": 5, "document": "agreed", "epoch": EPOCH}
PENDING: dict[str, Any] = {"pending_document": "new", "pending_fingerprint": NEW, "from_tick": 10}


def status(*, ok: bool = True, **more: Any) -> Answer:
    return Answer(ok=ok, sentence="", **{**AGREED, **more})


@pytest.mark.parametrize("answer", [None, status(ok=False), status(fingerprint=""), status(document="")])
def test_a_status_without_a_model_changes_nothing(answer: Answer | None, story: Story) -> None:
    story.versions.adopt_model("r", answer)
    assert (story.versions.of("r"), story.loads, story.answers()) == ("first", [], [])


@pytest.mark.parametrize(
    ("more", "change", "loads"),
    [
        ({}, 5, ["agreed"]),
        ({"pending": "preparing"}, 5, ["agreed"]),
        ({"pending": "offer", **PENDING}, 0, ["agreed"]),
        ({"pending": "take", **PENDING}, 0, ["agreed", "new"]),
        ({"pending": "take", **PENDING, "pending_fingerprint": "4" * 12}, 5, ["agreed"]),
    ],
    ids=["no change under way", "not offered yet", "offered", "to be taken", "taken, and still reported"],
)
def test_a_restarted_service_begins_with_the_model_that_was_agreed_on(more, change, loads, story):
    """The number of the change belongs to the model in force only while no other change is under way."""
    story.versions.adopt_model("r", status(**more))
    agreed = story.versions.agreed("r")
    assert agreed is not None
    assert (agreed.change, agreed.fingerprint, agreed.document) == (change, "4" * 12, "agreed")
    assert (story.versions.of("r"), story.loads) == ("agreed", loads)


@pytest.mark.parametrize(("pending", "in_force"), [("take", "new"), ("offer", "agreed")])
def test_a_restarted_service_takes_a_change_that_is_under_way_with_the_others(pending, in_force, story):
    story.versions.adopt_model("r", status(pending=pending, **PENDING))
    assert story.answers()[0] == ("ready", 5, "")
    assert [story.versions.begin("r", story.at(tick)) for tick in (9, 10)] == [False, pending == "take"]
    assert story.versions.of("r") == in_force


def test_an_agreed_model_that_cannot_be_loaded_is_refused_and_the_first_one_serves(story: Story) -> None:
    story.versions.adopt_model("r", status(document="bad"))
    assert story.versions.of("r") == "first"
    assert story.answers() == [("refused", 5, "no model")]


@pytest.mark.parametrize("ready", [False, True])
def test_an_offer_that_came_before_the_status_is_the_newer_one(ready: bool, story: Story) -> None:
    story.versions.hear("r", message("offer", 8, THIRD, document="newest"))
    if ready:
        story.answers()
    story.versions.adopt_model("r", status(pending="take", **PENDING))
    story.play(10)
    assert (story.versions.prepared("r"), story.versions.of("r")) == ("newest", "agreed")
