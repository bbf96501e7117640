"""A finding from its first sign to its end: stages, data for the search, and the messages about it."""

import copy
import json
from dataclasses import replace

import pytest
from tests.live.conftest import latent_of

from safedpa.dynamics import Setting, fingerprint, load_model, write_model
from safedpa.effects import effect
from safedpa.live.finding import FIRST_SEARCH, RobotDiagnosis
from safedpa.live.search_jobs import InlineWorker, SearchJob, WorkOutcome, named_candidate

CHANGE = 800
NUMBERS = {"angle": 0.08}
REPORT = {"stages": [{"heldout_error": 0.4}], "candidates": [{"effect": "steering_offset", "heldout_error": 0.02}]}


class Drive:
    """A drive in which the steering is bent, and its diagnosis; every message of it is recorded."""

    def __init__(self, car, worker, rows, message_of):
        self.worker, self.messages, self._message_of = worker, [], message_of
        self.diagnosis = RobotDiagnosis("r1", write_model(car), worker)
        self._rows, self._tick = rows, 0

    def go(self, ticks, stage=""):
        """Drives on; ends early when a message of the stage comes. Returns the messages."""
        begun = len(self.messages)
        for row in self._rows[self._tick : self._tick + ticks]:
            self._tick += 1
            message = self.diagnosis.observe(*self._message_of(row))
            if message is not None:
                self.messages.append(message)
                if message.stage == stage:
                    break
        return self.messages[begun:]

    def after_a_pause(self, seconds):
        """The message of a tick that comes so much later."""
        _, state, applied = self._rows[self._tick]
        return self.diagnosis.observe(*self._message_of((self._tick - 1 + round(20 * seconds), state, applied)))


@pytest.fixture(scope="module")
def at_the_search(car, drive_of, state_of, verdict_of, worker_class):
    """A drive up to the begin of the first search."""

    def message_of(row):
        state = state_of(row)
        return state, None, verdict_of(state)

    rows = list(drive_of(CHANGE + 3000, CHANGE, "steering_offset", **NUMBERS))
    drive = Drive(car, worker_class(), rows, message_of)
    drive.go(CHANGE + 1500, "searching")
    return drive


@pytest.fixture
def drive(at_the_search):
    """A copy of it, of this test only."""
    return copy.deepcopy(at_the_search)


@pytest.fixture
def fitted(car):
    return write_model(car.with_effect(effect("car", "steering_offset"), {"angle": Setting(0.08)}))


@pytest.fixture
def found(fitted):
    return WorkOutcome(json.dumps(REPORT), ("steering_offset",), {"steering_offset": fitted})


def test_stages_come_in_order_and_are_reported_once_a_second(drive):
    drive.go(200)
    stages = [message.stage for message in drive.messages]
    order = ["learning", "watching", "raised", "searching"]
    assert [stage for stage, before in zip(stages, [None, *stages], strict=False) if stage != before] == order
    seconds = [int(message.robot_time + 1e-9) for message in drive.messages]
    assert set(seconds) == set(range(seconds[-1] + 1))
    assert len(seconds) == seconds[-1] + 1 + 3  # and at each change of the stage


def test_the_sentence_of_each_stage_says_what_is_going_on(drive):
    first = {}
    for message in drive.messages:
        first.setdefault(message.stage, message.sentence)
    error = "the error over 1 s is not measured yet"
    assert first["learning"] == f"{error}; still learning the usual error: 20 s of driving to go"
    watching = next(message for message in drive.messages if message.stage == "watching")
    assert watching.sentence == (
        f"the error over 1 s is {watching.error:.3f}, within its band up to {watching.band:.3f}"
    )
    assert first["raised"].startswith("finding 1: the error over 1 s is ")
    assert f"its band ends at {watching.band:.3f}; " in first["raised"]
    assert first["raised"].endswith(" of 15 s are recorded for the search")
    assert first["searching"].endswith("; looking for the missing effect in 15 s of driving")
    assert {message.number for message in drive.messages} == {0, 1}


def test_the_search_gets_data_of_the_changed_robot_alone(drive, car):
    work = drive.worker.begun[0]
    assert work.task == "search"
    assert work.model == write_model(car)
    assert work.run.t[0] >= (CHANGE - 1) * 0.05
    assert FIRST_SEARCH - 0.2 <= work.run.duration <= FIRST_SEARCH + 0.2


def test_candidates_come_with_their_report_and_a_sentence(drive, found):
    drive.worker.ready = found
    messages = drive.go(260)
    assert {message.stage for message in messages} == {"candidates"}
    assert json.loads(messages[0].report) == REPORT
    assert [bool(message.report) for message in messages[:11]] == [True, *[False] * 9, True]
    assert "steering_offset explains it: held-out error 0.400 without, 0.020 with it" in messages[0].sentence
    assert "yaw" in messages[0].where


@pytest.mark.parametrize(
    ("outcome", "stage", "notice"),
    [
        (WorkOutcome(json.dumps({**REPORT, "candidates": []})), "nothing", "no effect of the library explains it"),
        (WorkOutcome(failure="its code was -9"), "nothing", "the search failed: its code was -9"),
        (
            WorkOutcome(json.dumps({"stages": [{"heldout_error": None}], "candidates": []}), ("drag",)),
            "candidates",
            "drag may explain it, but unseen data do not confirm it: held-out error unknown without, unknown with it",
        ),
    ],
)
def test_the_sentence_says_what_became_of_a_search(drive, outcome, stage, notice):
    drive.worker.ready = outcome
    message = drive.go(21)[-1]
    assert (message.stage, message.sentence.rpartition("; ")[2]) == (stage, notice)


def entry(error, decision="rejected", stage=0, effect="drag"):
    return {"stage": stage, "effect": effect, "heldout_error": error, "decision": decision}


@pytest.mark.parametrize(
    "entries",
    [
        [entry(None), entry(0.3, "accepted")],
        [entry(0.3, "accepted"), entry(0.2)],
        [entry(float("nan")), entry(0.3)],
        [entry(0.7), entry(0.3), entry(None)],
        [entry(0.1, "accepted", stage=1), entry(0.1, "accepted", effect="lag"), entry(0.3, "accepted")],
    ],
)
def test_of_the_first_stages_entries_of_one_name_the_accepted_or_best_one_is_meant(entries):
    assert named_candidate(entries, "drag")["heldout_error"] == 0.3
    assert named_candidate(entries, "wind") is None


def test_a_search_that_names_nothing_is_repeated_with_twice_the_data(drive):
    stages = set()
    for count in (2, 3):
        drive.worker.ready = WorkOutcome(json.dumps({**REPORT, "candidates": []}))
        while len(drive.worker.begun) < count:
            stages |= {message.stage for message in drive.go(1)}
    assert stages == {"nothing"}
    seconds = [work.run.duration for work in drive.worker.begun]
    assert seconds == pytest.approx([FIRST_SEARCH, 2.0 * FIRST_SEARCH, 4.0 * FIRST_SEARCH], abs=0.2)
    drive.worker.ready = WorkOutcome(json.dumps({**REPORT, "candidates": []}))
    drive.go(1800)
    assert len(drive.worker.begun) == 3, "with a minute of data nothing was found: two minutes are not tried"


def test_a_paused_search_is_begun_again_and_a_worker_without_a_search_is_left_alone(drive):
    """The worker may be making a model for the robot."""
    drive.diagnosis.pause()
    assert (drive.worker.cancelled, drive.diagnosis.stage) == (1, "raised")
    drive.worker.begin("r1", "a model is made")
    drive.diagnosis.pause()
    assert (drive.worker.cancelled, drive.worker.busy("r1")) == (1, True)
    drive.go(20)
    assert len(drive.worker.begun) == 2, "a busy worker gets no search"
    drive.worker.cancel("r1")
    assert drive.go(20)[-1].stage == "searching"
    assert drive.worker.begun[-1].task == "search"


def test_an_adopted_model_is_reported_with_the_error_before_and_after(drive, fitted):
    before = drive.messages[-1]
    drive.diagnosis.adopt(fitted)
    assert drive.worker.cancelled == 1
    last = drive.go(200)[-1]
    assert last.stage == "learning"
    assert last.model != before.model
    assert last.error < 0.2 * before.error
    assert f"{before.error:.3f} with the previous model" in last.sentence


@pytest.mark.parametrize(("later", "reported"), [(1.0, True), (59.0, True), (62.0, False), (600.0, False)])
def test_the_error_before_is_reported_for_a_minute_after_a_model_was_adopted(drive, fitted, later, reported):
    drive.diagnosis.adopt(fitted)
    assert ("with the previous model" in drive.after_a_pause(later).sentence) is reported


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


def test_a_dismissed_error_is_usual_from_then_on(drive):
    drive.diagnosis.dismiss()
    drive.go(1500)
    assert drive.diagnosis.stage == "watching"
    assert drive.diagnosis.number == 1


@pytest.mark.parametrize(
    ("applied_by", "status", "coverage"),
    [("filter", "passed", 0.0), ("watchdog", "passed", 1.0), ("filter", "fallback", 1.0)],
)
def test_a_step_counts_for_the_margin_if_the_filter_predicted_it_and_was_obeyed(
    car, worker, drive_of, state_of, verdict_of, applied_by, status, coverage
):
    diagnosis = RobotDiagnosis("r1", write_model(car), worker)
    first, second = (state_of(row) for row in drive_of(2))
    diagnosis.observe(first, None, replace(verdict_of(first), status=status))
    message = diagnosis.observe(replace(second, applied_by=applied_by), None, replace(verdict_of(second), h_now=0.0))
    assert diagnosis.watch.coverage == coverage
    assert message is None, "once a second is enough"


def test_a_latent_counts_only_with_the_model_that_it_was_estimated_for(worker, drive_of, state_of, verdict_of):
    free, errors = load_model("car"), []
    for model in (fingerprint(free), "0123456789ab", ""):
        diagnosis = RobotDiagnosis("r1", write_model(free), worker)
        for row in drive_of(250):
            state = state_of(row)
            latent = replace(latent_of(state, model), values=tuple(free.latent + 0.5)) if model else None
            diagnosis.observe(state, latent, verdict_of(state))
        errors.append(diagnosis.watch.error)
    own, other, none = errors
    assert other == none
    assert own != pytest.approx(none, rel=0.1)


@pytest.mark.long
def test_the_search_itself_finds_the_bent_steering_in_fifteen_seconds(drive):
    begun = drive.worker.begun[0]
    inline = InlineWorker(lambda model, run, footprint: f"{len(run.t)} rows, {footprint}")
    inline.begin("r1", begun)
    outcome = inline.outcome("r1")
    assert inline.outcome("r1") is None
    assert outcome.effects[0] == "steering_offset"
    inline.begin(
        "r1", SearchJob("prepare", begun.model, begun.run, effect="steering_offset", footprint=(0.1, 0.4, 0.2))
    )
    made = inline.outcome("r1")
    assert 'name = "steering_offset"' in made.documents["steering_offset"]
    assert "(0.1, 0.4, 0.2)" in made.margin
    inline.begin("r1", SearchJob("prepare", begun.model, begun.run, effect="flood"))
    assert "flood" in inline.outcome("r1").failure
