"""What the experiment of live diagnosis drives, takes down and accepts, from messages that are written down by hand."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from safedpa.bus import MODEL, ModelMessage, Received
from safedpa_lab.experiments import live, live_drive
from safedpa_lab.experiments.live_drive import LiveDrive, _Notes


@pytest.mark.parametrize("quiet", [True, False])
def test_every_case_is_driven_on_every_scene_and_quiet_drives_are_told_apart(
    quiet: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    case, other = list(live.CASES)[:2]
    asked: list[tuple[str, int, float, float]] = []

    def drive_live(name: str, seed: int, seconds: float, after: float, *, model: str) -> LiveDrive:
        assert model == "car"
        asked.append((name, seed, seconds, after))
        return LiveDrive(name, seed, collisions=seed, driven=seconds)

    monkeypatch.setattr(live, "drive_live", drive_live)
    cases = (case, live.NOTHING, other) if quiet else (case, other)
    wanted = live.LiveExperiment(cases, (1, 2, 3), (8, 9), 1800.0, 20.0, model="car")
    told: list[tuple[int, int]] = []
    found = live.live_experiment(wanted, lambda *one: told.append(one))
    drives = [(name, seed, 150.0, 20.0) for name in (case, other) for seed in (1, 2, 3)]
    drives += [(live.NOTHING, seed, 1800.0, 20.0) for seed in (8, 9)] if quiet else []
    assert asked == drives
    assert told == [(number, len(drives)) for number in range(1, len(drives) + 1)]
    assert [(row["case"], row["effect"], row["drives"], row["collisions"]) for row in found["rows"]] == [
        (case, live.CASES[case], 3, 6), (other, live.CASES[other], 3, 6),
    ]  # fmt: skip
    if quiet:
        assert (found["quiet"]["hours"], found["quiet"]["collisions"]) == (1.0, 17)
    else:
        assert found["quiet"] is None


@pytest.mark.parametrize(
    ("seconds", "taken", "periods"), [(10.0, None, 200), (60.0, 10.0, 702), (60.0, 50.0, 1200), (1.0, 10.0, 20)]
)
def test_a_drive_goes_on_for_25_seconds_with_the_changed_model(
    seconds: float, taken: float | None, periods: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And no longer than it was asked for."""
    robot = SimpleNamespace(collisions=[], goals_reached=0, changed_at=None, tick=0)
    lived: list[int] = []

    def driven(_robot: Any, _nodes: Any, count: int, hear: Any) -> Iterator[Any]:
        for tick in range(count):
            if taken is not None and tick == round(taken / 0.05):
                hear(item(model("take", tick)))
            lived.append(tick)
            verdict = SimpleNamespace(h_now=1.0 - 0.001 * tick)
            yield SimpleNamespace(verdict=verdict, state=SimpleNamespace(robot_time=tick / 20.0))

    monkeypatch.setattr(live_drive, "CarRobot", lambda *_, **__: robot)
    monkeypatch.setattr(live_drive, "load_model", lambda _: None)
    monkeypatch.setattr(live_drive, "_nodes", lambda _: (None, []))
    monkeypatch.setattr(live_drive, "drive", driven)
    found = live_drive.drive_live("nothing", 1, seconds)
    assert len(lived) == periods
    assert found.taken == (taken if taken is not None and taken < seconds else None)
    assert found.least_h == pytest.approx(1.0 - 0.001 * (periods - 1))


def model(step: str, tick: int) -> ModelMessage:
    return ModelMessage(
        epoch=1, tick=tick, robot_time=0.05 * tick, publish_time=0.0, step=step, change=1, fingerprint="f",
        replaces="e", from_tick=tick,
    )  # fmt: skip


def item(message: ModelMessage) -> Received:
    return Received(MODEL, "r1", message, b"", "", 0.0)


def test_the_model_changes_at_the_first_tick_from_which_it_is_used() -> None:
    node: Any = None
    notes = _Notes(found := LiveDrive("hitch", 1), node, 0.0)
    for step, tick in (("offer", 100), ("drop", 120)):
        notes.hear(item(model(step, tick)))
    assert found.taken is None
    for tick in (200, 300):
        notes.hear(item(model("take", tick)))
    assert found.taken == pytest.approx(10.0)


def candidates(error: float, alike: tuple[str, ...] = (), effect: str = "drag") -> dict[str, Any]:
    """What a search says: 1.0 was the error on unseen data before; others of the list are not spoken of."""
    own = {
        "stage": 0, "effect": effect, "heldout_error": error, "indistinguishable_from": alike,
        "parameters": {"c": {"value": 0.5}},
    }  # fmt: skip
    others = [
        {**own, "stage": 1, "heldout_error": 9.0, "indistinguishable_from": ("x",), "parameters": {}},
        {**own, "effect": "wind", "heldout_error": 9.0, "indistinguishable_from": ("y",), "parameters": {}},
    ]
    return {"candidates": [others[0], own, others[1]], "stages": [{"heldout_error": 1.0}]}


def outcome(*effects: str, **report: Any) -> Any:
    documents = dict.fromkeys(effects, "text")
    return SimpleNamespace(documents=documents, effects=list(effects), report=json.dumps(candidates(**report)))


class Diagnosis:
    """Of one robot; what it is asked for is kept."""

    def __init__(self) -> None:
        self.of_robot: Any = None
        self.asked: list[str] = []

    def diagnosis_of(self, _robot: str) -> Any:
        return self.of_robot

    def answer(self, _robot: str, request: Any) -> None:
        assert (request.do, request.model, request.finding) == ("accept", "f", 3)
        self.asked.append(request.effect)

    def says(self, outcome: Any, time: float = 0.0) -> None:
        self.of_robot = SimpleNamespace(outcome=outcome, time=time, fingerprint="f", number=3)


def notes(reading: float = 0.0) -> tuple[_Notes, LiveDrive, Diagnosis]:
    found, node = LiveDrive("hitch", 1), Diagnosis()
    given: Any = node
    return _Notes(found, given, reading), found, node


@pytest.mark.parametrize(("error", "accepted"), [(0.39, ["drag"]), (0.41, [])])
def test_an_effect_is_accepted_where_unseen_data_promise_the_fall_to_forty_per_cent(
    error: float, accepted: list[str]
) -> None:
    taken_down, found, node = notes()
    taken_down._accept(0.0)
    node.says(None)
    taken_down._accept(1.0)
    node.says(outcome("drag", "wind", error=error), time=7.0)
    for now in (7.0, 8.0, 9.0):
        taken_down._accept(now)
    assert node.asked == accepted, "once for each outcome"
    assert (found.found, found.effect, found.group, found.numbers) == (7.0, "drag", (), {"c": 0.5})


def test_an_effect_that_others_look_like_waits_for_a_second_search() -> None:
    taken_down, found, node = notes()
    node.says(outcome("drag", error=0.1, alike=("slope",)), time=7.0)
    taken_down._accept(7.0)
    assert (node.asked, found.group) == ([], ("slope",))
    node.says(outcome("drag", error=0.1, alike=("slope",)), time=17.0)
    taken_down._accept(17.0)
    assert node.asked == ["drag"]
    assert found.found == 7.0, "it was named then"


def test_an_outcome_is_read_before_it_is_accepted() -> None:
    taken_down, _, node = notes(reading=5.0)
    node.says(outcome("drag", error=0.1))
    for now, asked in ((10.0, []), (14.9, []), (15.0, ["drag"]), (16.0, ["drag"])):
        taken_down._accept(now)
        assert node.asked == asked


def test_without_a_candidate_and_after_a_change_nothing_is_accepted() -> None:
    taken_down, found, node = notes()
    node.says(outcome(error=0.1))
    taken_down._accept(1.0)
    found.taken = 2.0
    node.says(outcome("drag", error=0.1))
    taken_down._accept(3.0)
    assert (node.asked, found.found, found.effect) == ([], None, LiveDrive("hitch", 1).effect)
    assert dataclasses.replace(found, taken=None) == LiveDrive("hitch", 1)
