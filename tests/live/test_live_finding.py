"""A finding from its first sign to its end: stages, data for the search, what is told and when."""

from __future__ import annotations

import json

import pytest

from safedpa.dynamics import Setting, write_model
from safedpa.effects import effect
from safedpa.live.finding import FIRST_SEARCH, RobotDiagnosis
from safedpa.live.work import InlineWorker, Work, WorkOutcome

CHANGE = 800
NUMBERS = {"angle": 0.08}
REPORT = {"stages": [{"heldout_error": 0.4}], "candidates": [{"effect": "steering_offset", "heldout_error": 0.02}]}


@pytest.fixture
def told(car, worker, drive_of, state_of, verdict_of):
    """told(ticks, until stage): every message of a drive in which the steering is bent, and the diagnosis."""

    def drive(ticks, stage="", **change):
        diagnosis, messages = RobotDiagnosis("r1", write_model(car), worker), []
        rows = drive_of(ticks, CHANGE, "steering_offset", **(change or NUMBERS))
        for row in rows:
            state = state_of(row)
            message = diagnosis.observe(state, None, verdict_of(state))
            if message is not None:
                messages.append(message)
                if message.stage == stage:
                    break
        return diagnosis, messages, lambda: next(rows)

    return drive


def fitted(car):
    return write_model(car.with_effect(effect("car", "steering_offset"), {"angle": Setting(0.08)}))


def found(car):
    return WorkOutcome(json.dumps(REPORT), ("steering_offset",), {"steering_offset": fitted(car)})


def test_stages_come_in_order_and_are_told_once_a_second(told):
    _, messages, _ = told(CHANGE + 500)
    stages = [message.stage for message in messages]
    order = ["learning", "watching", "raised", "searching"]
    assert [stage for stage, before in zip(stages, [None, *stages], strict=False) if stage != before] == order
    seconds = [int(message.robot_time + 1e-9) for message in messages]
    assert set(seconds) == set(range(65))
    assert len(seconds) == 65 + 3  # and at each change of the stage


def test_the_search_gets_data_of_the_changed_robot_alone(told, worker, car):
    told(CHANGE + 500, "searching")
    work = worker.begun[0]
    assert work.task == "search"
    assert work.model == write_model(car)
    assert work.run.t[0] >= (CHANGE - 1) * 0.05
    assert work.run.duration >= FIRST_SEARCH - 0.2


def test_candidates_come_with_their_report_and_a_sentence(told, worker, car, state_of, verdict_of):
    diagnosis, _, row = told(CHANGE + 1500, "searching")
    worker.ready = found(car)
    messages = []
    for _ in range(260):
        state = state_of(row())
        messages.append(diagnosis.observe(state, None, verdict_of(state)))
    messages = [message for message in messages if message is not None]
    assert {message.stage for message in messages} == {"candidates"}
    assert json.loads(messages[0].report) == REPORT
    assert [bool(message.report) for message in messages[:11]] == [True, *[False] * 9, True]
    assert "steering_offset explains it: held-out error 0.400 without, 0.020 with it" in messages[0].sentence
    assert "yaw" in messages[0].where


def test_a_search_that_names_nothing_is_repeated_with_twice_the_data(told, worker, state_of, verdict_of):
    diagnosis, _, row = told(CHANGE + 1500, "searching")
    worker.ready = WorkOutcome(json.dumps({**REPORT, "candidates": []}))
    stages = set()
    while len(worker.begun) < 2:
        state = state_of(row())
        diagnosis.observe(state, None, verdict_of(state))
        stages.add(diagnosis.stage)
    assert "nothing" in stages
    assert worker.begun[1].run.duration == pytest.approx(2 * FIRST_SEARCH, abs=0.2)


def test_a_failed_search_says_why(told, worker, state_of, verdict_of):
    diagnosis, _, row = told(CHANGE + 1500, "searching")
    worker.ready = WorkOutcome(failure="its process ended with code -9, 3 times")
    messages = []
    for _ in range(21):
        state = state_of(row())
        messages.append(diagnosis.observe(state, None, verdict_of(state)))
    assert any(message is not None and "code -9" in message.sentence for message in messages)


def test_a_model_that_is_taken_over_is_told_with_the_error_before_and_after(told, worker, car, state_of, verdict_of):
    diagnosis, messages, row = told(CHANGE + 1500, "searching")
    before = messages[-1].error
    diagnosis.adopt(fitted(car))
    assert worker.cancelled == 1
    after = []
    for _ in range(200):
        state = state_of(row())
        after.append(diagnosis.observe(state, None, verdict_of(state)))
    last = [message for message in after if message is not None][-1]
    assert last.stage == "learning"
    assert last.model != messages[-1].model
    assert last.error < 0.2 * before
    assert f"{before:.3f} with the model before" in last.sentence


@pytest.mark.parametrize(("later", "told"), [(0.0, True), (59.9, True), (60.1, False), (600.0, False)])
def test_the_error_before_is_told_for_a_minute_after_a_model_was_taken_over(car, worker, later, told):
    diagnosis = RobotDiagnosis("r1", write_model(car), worker)
    diagnosis.time = 1000.0
    diagnosis.adopt(fitted(car))
    diagnosis.time += later
    assert ("with the model before" in diagnosis._sentence("learning")) is told


def test_when_the_error_returns_to_its_band_the_finding_is_closed_and_the_search_given_up(
    car, worker, drive_of, state_of, verdict_of
):
    diagnosis, stages = RobotDiagnosis("r1", write_model(car), worker), []
    rows = [*drive_of(CHANGE + 400, CHANGE, "steering_offset", **NUMBERS)]
    calm = [*drive_of(3000)]
    for tick, state, applied in [*rows, *((tick + 20 + CHANGE + 400, s, a) for tick, s, a in calm)]:
        message = state_of((tick, state, applied))
        diagnosis.observe(message, None, verdict_of(message))
        stages.append(diagnosis.stage)
    assert "searching" in stages
    assert stages[-1] == "watching"
    assert worker.cancelled == 1
    assert diagnosis.number == 1


def test_a_dismissed_error_is_usual_from_then_on(told, worker, state_of, verdict_of):
    diagnosis, _, row = told(CHANGE + 3000, "searching")
    diagnosis.dismiss()
    for _ in range(1500):
        state = state_of(row())
        diagnosis.observe(state, None, verdict_of(state))
    assert diagnosis.stage == "watching"
    assert diagnosis.number == 1


@pytest.mark.long
def test_the_search_itself_finds_the_bent_steering_in_fifteen_seconds(told, worker, car):
    told(CHANGE + 500, "searching")
    inline = InlineWorker(lambda model, run, footprint: f"{len(run.t)} rows, {footprint}")
    inline.begin("r1", worker.begun[0])
    outcome = inline.outcome("r1")
    assert inline.outcome("r1") is None
    assert outcome.effects[0] == "steering_offset"
    begun = worker.begun[0]
    inline.begin("r1", Work("prepare", begun.model, begun.run, effect="steering_offset", footprint=(0.1, 0.4, 0.2)))
    made = inline.outcome("r1")
    assert 'name = "steering_offset"' in made.documents["steering_offset"]
    assert "(0.1, 0.4, 0.2)" in made.margin
    inline.begin("r1", Work("prepare", begun.model, begun.run, effect="flood"))
    assert "flood" in inline.outcome("r1").failure
