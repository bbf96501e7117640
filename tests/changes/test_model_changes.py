"""All services of a robot change their model at one tick, or none does, whatever is lost and whichever process dies."""

import dataclasses
import itertools
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as some

from safedpa.bus import Request, TakeoverMessage
from safedpa.errors import InputError, RecordingError
from safedpa.live.change import ModelChanges
from safedpa.live.versions import ModelVersion, OfferedEffect, PersistedState, VersionFolder

SERVICES = ("adaptation", "policy", "safety_filter")
QUIET = 1500
"""Ticks without a fault after which everything must have settled: the pauses between failed repairs included."""
SOON = 150
"""The same where no repair fails."""


@pytest.fixture
def fleet(fleet_of: Any, tmp_path: Path) -> Any:
    """One with a folder, a tick old, that may accept drag."""
    fleet = fleet_of(tmp_path)
    fleet.turn()
    fleet.propose("drag", "wind")
    return fleet


def steps(fleet: Any) -> list[str]:
    return [message.step for message in fleet.spoken]


def test_everyone_changes_at_the_named_tick(fleet: Any) -> None:
    answer, in_force = fleet.ask("accept", "drag"), {}
    assert answer.ok
    for _ in range(30):
        fleet.turn()
        in_force[fleet.tick] = fleet.ask("status").fingerprint
    assert steps(fleet) == ["offer", "take"]
    offer, take = fleet.spoken
    assert (offer.document, offer.margin, offer.replaces) == ("document drag", "margin drag", "first")
    assert (offer.who, offer.why) == ("alice", "accept drag of finding 1")
    changed = fleet.used.index(("print drag",) * 3) + 2  # turn n is tick n + 2 of the robot
    assert changed == take.from_tick
    assert in_force == {tick: "first" if tick < take.from_tick else "print drag" for tick in in_force}
    assert set(fleet.used) == {("first",) * 3, ("print drag",) * 3}, "at no tick do two of them differ"
    assert [answer.state for answer in fleet.heard] == ["ready"] * 3 + ["taken"] * 3
    assert {answer.tick for answer in fleet.heard if answer.state == "taken"} == {take.from_tick}
    assert fleet.changes.sentence == "change 1 (accept drag of finding 1): taken by all services"
    assert fleet.ask("status").candidates == (), "they were sought for the model that is gone"


def test_what_one_cannot_load_is_dropped_by_all(fleet_of: Any, tmp_path: Path) -> None:
    fleet = fleet_of(tmp_path, {"policy": frozenset(["document drag"])})
    fleet.turn()
    fleet.propose("drag")
    fleet.ask("accept", "drag")
    fleet.turn(100)
    assert steps(fleet) == ["offer", "drop"]
    assert fleet.models == {"first"}
    assert "policy refused it: policy cannot load document drag" in fleet.spoken[-1].why
    assert "policy refused it" in fleet.changes.sentence
    assert all(service.versions.prepared("r") is None for service in fleet.services.values())


@pytest.mark.parametrize("silent", SERVICES)
def test_a_service_that_does_not_answer_in_time_keeps_all_on_the_old_model(fleet: Any, silent: str) -> None:
    fleet.deliver = lambda message: int(getattr(message, "service", "") != silent)
    fleet.ask("accept", "drag")
    fleet.turn(520)
    assert f"{silent} did not answer within 25 s; attempt 2 of 3 begins" in fleet.changes.sentence
    fleet.turn(1200)
    assert steps(fleet) == ["offer", "drop"] * 3, "it is offered again by itself"
    assert fleet.models == {"first"}
    assert fleet.changes.sentence.endswith(f"dropped, {silent} did not answer within 25 s")


def test_an_offer_that_was_not_answered_succeeds_by_itself_once_all_answer(fleet: Any) -> None:
    fleet.deliver = lambda message: int(getattr(message, "service", "") != "policy")
    fleet.ask("accept", "drag")
    fleet.turn(450)
    fleet.deliver = lambda message: 1
    fleet.turn(150)
    assert steps(fleet)[:3] == ["offer", "drop", "offer"]
    assert fleet.models == {"print drag"}


def test_an_answer_for_another_model_is_no_answer(fleet: Any) -> None:
    hear = fleet.changes.hear

    def altered(message: Any) -> None:
        foreign = getattr(message, "service", "") == "policy" and isinstance(message, TakeoverMessage)
        hear(dataclasses.replace(message, fingerprint="other") if foreign else message)

    fleet.changes.hear = altered
    fleet.ask("accept", "drag")
    fleet.turn(20)
    assert "policy answered for model other" in fleet.changes.sentence
    assert steps(fleet) == ["offer", "drop"]
    assert fleet.models == {"first"}


def test_a_late_answer_to_a_dropped_change_does_not_count_for_the_next(fleet: Any) -> None:
    late: list[TakeoverMessage] = []

    def away(message: Any) -> int:
        if getattr(message, "service", "") != "policy":
            return 1
        late.append(message)
        return 0

    fleet.deliver = away
    fleet.ask("accept", "drag")
    fleet.turn(508)  # 25 s and a few ticks
    assert [(message.change, message.state) for message in late] == [(1, "ready"), (2, "ready")]
    fleet.changes.hear(late[0])
    fleet.turn(1200)
    assert steps(fleet) == ["offer", "drop"] * 3
    assert fleet.models == {"first"}


def test_roll_back_returns_to_the_version_before_and_no_further(fleet: Any) -> None:
    fleet.ask("accept", "drag")
    fleet.turn(30)
    fleet.propose("wind")
    fleet.ask("accept", "wind")
    fleet.turn(30)
    assert fleet.models == {"print wind"}
    for wanted in ("print drag", "first"):
        assert fleet.ask("roll_back").ok
        fleet.turn(30)
        assert fleet.models == {wanted}
    answer = fleet.ask("roll_back")
    assert not answer.ok
    assert "there is no earlier one" in answer.sentence


def test_of_two_people_the_first_wins_and_the_second_hears_why(fleet: Any) -> None:
    assert fleet.ask("accept", "drag", who="alice").ok
    for who in ("bob", "carol"):
        second = fleet.ask("accept", "wind", who=who)
        assert not second.ok
        assert second.sentence.startswith("refused: change 1 (accept drag of finding 1) by alice is in progress")
    fleet.turn(30)
    late = fleet.ask("accept", "wind", model="first")
    assert not late.ok
    assert "the active model is print drag, you saw first" in late.sentence
    assert fleet.models == {"print drag"}


@pytest.mark.parametrize(
    ("request_", "reason"),
    [
        (Request(do="acept", effect="drag", model="first", finding=1), "did you mean 'accept'"),
        (Request(do="accept", effect="drag", model="other", finding=1), "you saw other"),
        (Request(do="accept", effect="drag", finding=1), "you name none"),
        (Request(do="accept", effect="drag", model="first", finding=2), "newest finding has number 1, you name 2"),
        (Request(do="accept", effect="dragg", model="first", finding=1), "did you mean 'drag'"),
        (Request(do="reject", model="first", finding=1), "effect '' is not a candidate"),
        (Request(do="roll_back", model="first"), "there is no earlier one"),
    ],
)
def test_what_cannot_be_meant_is_refused_with_the_reason(fleet: Any, request_: Request, reason: str) -> None:
    answer = fleet.changes.answer(request_)
    assert not answer.ok
    assert answer.sentence.startswith("refused: ")
    assert reason in answer.sentence
    fleet.turn(20)
    assert fleet.spoken == []
    assert fleet.models == {"first"}


def test_nothing_is_accepted_for_a_robot_that_was_not_heard(fleet_of: Any) -> None:
    fleet = fleet_of()
    fleet.propose("drag")
    assert "has not sent a state yet" in fleet.ask("accept", "drag").sentence


def test_a_rejected_effect_is_no_candidate_any_more_and_the_recording_says_who(fleet: Any, tmp_path: Path) -> None:
    assert fleet.ask("reject", "drag", who="bob").ok
    fleet.turn()
    (message,) = fleet.spoken
    assert (message.step, message.who, message.why) == ("drop", "bob", "reject drag of finding 1")
    assert not fleet.ask("accept", "drag").ok
    assert fleet.ask("status").candidates == ("wind",)
    assert ModelChanges(ModelVersion("first", ""), VersionFolder(tmp_path)).rejected == {(1, "drag")}


def test_a_model_that_is_made_on_demand(fleet: Any, candidate_of: Any) -> None:
    fleet.changes.propose(1, {"drag": OfferedEffect("drag")})
    fleet.ask("accept", "drag")
    fleet.turn(50)
    assert fleet.spoken == []
    assert fleet.changes.wanted == OfferedEffect("drag")
    assert fleet.ask("status").pending == "preparing"
    fleet.changes.prepared(candidate_of("wind"))
    assert fleet.changes.wanted is not None, "that was not asked for"
    fleet.changes.prepared(candidate_of("drag"))
    fleet.turn(30)
    assert fleet.models == {"print drag"}


def test_a_model_that_cannot_be_made_is_dropped_and_a_late_one_is_awaited_three_times(fleet: Any) -> None:
    for reason in ("the data do not tell", ""):
        fleet.changes.propose(1, {"drag": OfferedEffect("drag")})
        fleet.ask("accept", "drag")
        if reason:
            fleet.changes.failed(reason)
        fleet.turn(3500)
        assert (fleet.changes.wanted is None) is bool(reason)
        fleet.turn(200)
        assert fleet.changes.wanted is None
        assert (reason or "not made within 60 s") in fleet.changes.sentence
    assert steps(fleet) == ["drop"] * 4


@pytest.mark.parametrize("name", SERVICES)
@pytest.mark.parametrize("after", range(12))
def test_a_service_killed_at_any_moment_ends_on_the_model_of_the_others(fleet: Any, name: str, after: int) -> None:
    fleet.ask("accept", "drag")
    fleet.turn(after)
    fleet.restart_service(name)
    fleet.turn(SOON)
    assert len(fleet.models) == 1
    assert fleet.models == {fleet.changes.fingerprint}
    assert all(len(set(models)) <= 2 for models in fleet.used)


@pytest.mark.parametrize("retained", [True, False])
@pytest.mark.parametrize("after", range(12))
def test_a_coordinator_killed_at_any_moment_leaves_one_model(fleet_of: Any, tmp_path: Path, after: int, retained: bool):
    fleet = fleet_of(tmp_path if retained else None)
    fleet.turn()
    fleet.propose("drag")
    fleet.ask("accept", "drag")
    fleet.turn(after)
    decided = "take" in steps(fleet)
    fleet.restart_coordinator()
    fleet.turn(SOON)
    assert len(fleet.models) == 1
    assert fleet.models == {fleet.changes.fingerprint}
    if retained:
        assert fleet.models == {"print drag" if decided else "first"}, "what was decided stays decided"


def test_an_undecided_offer_is_dropped_after_a_restart(fleet: Any) -> None:
    fleet.ask("accept", "drag")
    fleet.turn(1)
    fleet.restart_coordinator()
    fleet.turn(5)
    assert steps(fleet) == ["offer", "drop"]
    assert "the diagnosis was restarted" in fleet.spoken[-1].why
    fleet.propose("drag")
    assert fleet.ask("accept", "drag").change == 2, "numbers are not used twice"


def test_a_service_that_missed_the_answer_to_its_question_is_repaired(fleet: Any) -> None:
    """It was killed, and the diagnosis was away when it asked."""
    fleet.ask("accept", "drag")
    fleet.turn(30)
    away, fleet.changes = fleet.changes, None
    fleet.restart_service("adaptation")
    fleet.turn(5)
    assert fleet.models == {"first", "print drag"}
    fleet.changes = away
    fleet.turn(30)
    assert fleet.models == {"print drag"}
    assert fleet.spoken[-1].why.startswith("repair, adaptation uses first")
    assert [version.fingerprint for version in fleet.changes.versions] == ["first", "print drag"]


def test_health_from_before_a_restart_of_the_robot_is_no_reason_to_repair(fleet: Any) -> None:
    old = fleet.health_of(fleet.services["policy"])
    fleet.turn(30)
    fleet.restart_robot()
    fleet.turn(20)
    for tick in (500, 5):
        fleet.changes.hear(dataclasses.replace(old, epoch=1, tick=tick, model="before"))
        assert fleet.changes.step(fleet.state()) is None
    fleet.changes.hear(dataclasses.replace(old, epoch=2, tick=5, model="before"))
    assert fleet.changes.step(fleet.state()) is None, "it may not have reached the tick of the change"
    fleet.changes.hear(dataclasses.replace(old, epoch=2, tick=30, model="before"))
    offer = fleet.changes.step(fleet.state())
    assert offer is not None
    assert offer.why == "repair, policy uses before"


def test_a_repair_that_comes_to_nothing_is_tried_again_less_and_less_often(fleet: Any) -> None:
    fleet.deliver = lambda message: 0
    stray = dataclasses.replace(fleet.health_of(fleet.services["policy"]), model="before")
    offers = []
    for _ in range(5000):
        state = fleet.state()
        fleet.changes.hear(dataclasses.replace(stray, epoch=state.epoch, tick=state.tick))
        message = fleet.changes.step(state)
        if message is not None and message.step == "offer":
            offers.append(state.tick)
    pauses = [later - sooner - 500 for sooner, later in itertools.pairwise(offers)]  # each offer is open for 25 s
    assert len(offers) >= 4
    assert pauses[0] >= 200
    assert all(later > 1.5 * sooner for sooner, later in itertools.pairwise(pauses))


def test_when_a_restarted_service_cannot_use_the_new_model_everyone_goes_back(fleet: Any) -> None:
    fleet.ask("accept", "drag")
    fleet.turn(30)
    fleet.broken = {"policy": frozenset(["document drag"])}  # its weights were taken away, say
    fleet.restart_service("policy")
    fleet.turn(100)
    assert fleet.models == {"first"}
    assert [version.fingerprint for version in fleet.changes.versions] == ["first"]


def test_a_robot_that_restarts_amid_a_change_begins_with_the_new_model(fleet: Any) -> None:
    fleet.ask("accept", "drag")
    fleet.turn(3)
    assert "take" in steps(fleet)
    assert fleet.ask("status").fingerprint == "first"
    fleet.restart_robot()
    fleet.turn(1)
    assert fleet.tick < fleet.spoken[-1].from_tick, "that tick is of the drive before"
    assert fleet.models == {"print drag"} == {fleet.changes.fingerprint}
    fleet.turn(30)
    assert fleet.models == {"print drag"}
    assert all(len(set(models)) == 1 for models in fleet.used)


def test_a_service_that_missed_the_decision_hears_it_again(fleet: Any) -> None:
    lost = iter([0])
    fleet.deliver = lambda message: next(lost, 1) if getattr(message, "step", "") == "take" else 1
    fleet.ask("accept", "drag")
    fleet.turn(60)
    assert fleet.models == {"print drag"}
    assert steps(fleet)[:3] == ["offer", "take", "take"]
    assert "taken by all services" in fleet.changes.sentence


@pytest.mark.parametrize(("room_for", "reported"), [(0, ["drop"]), (1, ["offer", "drop"])])
def test_nothing_is_decided_that_cannot_be_kept(fleet_of, monkeypatch, room_for, reported):
    room = iter(range(room_for))

    def full(self: VersionFolder, retained: PersistedState) -> None:
        if next(room, None) is None:
            raise RecordingError("folder: cannot be written (No space left on device); free space there")

    fleet = fleet_of(Path("never/made"))
    monkeypatch.setattr(VersionFolder, "save", full)
    fleet.turn()
    fleet.propose("drag")
    fleet.ask("accept", "drag")
    fleet.turn(30)
    assert steps(fleet) == reported
    assert "No space left" in fleet.changes.sentence
    assert fleet.models == {"first"}


def test_versions_survive_on_disk_as_files_that_a_person_can_read(fleet: Any, tmp_path: Path) -> None:
    fleet.ask("accept", "drag")
    fleet.turn(30)
    assert (tmp_path / "model-001-print drag.toml").read_text() == "document drag"
    assert (tmp_path / "model-001-print drag.margin.json").read_text() == "margin drag"
    retained = VersionFolder(tmp_path).load()
    assert retained is not None
    assert retained.versions == fleet.changes.versions
    assert not list(tmp_path.glob("*.new"))


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"versions": [], "change": 0, "offered": "", "rejected": []}', "\0"])
def test_a_broken_folder_is_refused_with_its_name(tmp_path: Path, text: str) -> None:
    (tmp_path / "changes.json").write_text(text)
    with pytest.raises(InputError, match=r"changes.json: .*move it away"):
        ModelChanges(ModelVersion("first", ""), VersionFolder(tmp_path))


def test_a_folder_that_cannot_be_made_is_an_error_of_writing(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RecordingError, match="cannot be written"):
        VersionFolder(tmp_path / "file" / "folder").save(PersistedState((ModelVersion("first", ""),)))


faults = some.lists(
    some.tuples(
        some.integers(0, 25),  # ticks before it
        some.sampled_from(
            ["accept drag", "accept wind", "roll back", "robot", "coordinator", "away", "back", *SERVICES]
        ),
    ),
    max_size=12,
)
losses = some.lists(some.sampled_from([0, 1, 1, 1, 2, 3]), min_size=1, max_size=40)


@pytest.mark.long
@given(story=faults, counts=losses, broken=some.sampled_from(["", *SERVICES]))
@settings(max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_whatever_happens_no_dropped_model_is_used_and_all_agree_in_the_end(
    fleet_of: Any, tmp_path_factory: pytest.TempPathFactory, story: Any, counts: list[int], broken: str
) -> None:
    """Losses, repetitions, deaths of services, coordinator and robot, in any order, while people click."""
    fleet = fleet_of(tmp_path_factory.mktemp("story"), {broken: frozenset(["document wind"])})
    number = iter(range(10**9))
    fleet.deliver = lambda message: counts[next(number) % len(counts)]
    fleet.turn()
    away = None
    for pause, event in story:
        fleet.turn(pause)
        if event == "away" and fleet.changes is not None:
            away, fleet.changes = fleet.changes, None
        elif event == "back" and fleet.changes is None:
            fleet.changes = away
        elif event in SERVICES:
            fleet.restart_service(event)
        elif event == "robot":
            fleet.restart_robot()
        elif fleet.changes is not None:
            _do(fleet, event)
    fleet.deliver = lambda message: 1
    fleet.changes = fleet.changes or away
    fleet.turn(QUIET)
    decided = {"first", *(message.fingerprint for message in fleet.spoken if message.step == "take")}
    assert {model for models in fleet.used for model in models} <= decided
    dropped = {(message.change, message.fingerprint) for message in fleet.spoken if message.step == "drop"}
    assert not dropped & {(message.change, message.fingerprint) for message in fleet.spoken if message.step == "take"}
    assert fleet.models == {fleet.changes.fingerprint}
    assert fleet.changes.under_way == ""


def _do(fleet: Any, event: str) -> None:
    if event == "coordinator":
        fleet.restart_coordinator()
    elif event == "roll back":
        fleet.ask("roll_back")
    elif event.startswith("accept"):
        fleet.propose("drag", "wind")
        fleet.ask("accept", event.split()[1])
