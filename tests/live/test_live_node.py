"""The diagnosis as a node: what is proposed, accepted, rejected, prepared, and forgotten."""

import json
from dataclasses import replace

import pytest

from safedpa.bus import FINDING, LATENT, MODEL, VERDICT, Request, Stale, TakeoverMessage
from safedpa.dynamics import Setting, fingerprint, parse_model, write_model
from safedpa.effects import effect
from safedpa.errors import MessageError, ModelFileError
from safedpa.live.candidate_forecasts import CandidateForecasts, forecast_with
from safedpa.live.node import DiagnosisNode
from safedpa.live.search_jobs import WorkOutcome
from safedpa.safety.margins.calibration import MarginCalibration, margin_text

CHANGE = 800
REPORT = json.dumps(
    {
        "stages": [{"heldout_error": 0.4}],
        "candidates": [{"effect": name, "heldout_error": 0.02} for name in ("steering_offset", "steering_gain")],
    }
)


class Driven:
    """The node of a car whose steering is bent, and services that agree with every offer."""

    def __init__(self, car, worker, rows, state_of, verdict_of, **more):
        self.node, self.worker = DiagnosisNode(write_model(car), worker, **more), worker
        self.rows, self.state_of, self.verdict_of = rows, state_of, verdict_of
        self.car, self.reported, self.changes = car, [], []

    def tick(self, refuse=""):
        state = self.state_of(next(self.rows))
        out = self.node.step("r1", state, {LATENT: Stale(LATENT, None), VERDICT: self.verdict_of(state)})
        self.reported += [out[FINDING]] if FINDING in out else []
        if MODEL in out:
            self.changes.append(out[MODEL])
            self._answer(state, out[MODEL], refuse)

    def _answer(self, state, message, refuse):
        phrase = {"offer": "ready", "take": "taken"}
        for service in ("adaptation", "policy", "safety_filter") if message.step in phrase else ():
            answer = "refused" if service == refuse else phrase[message.step]
            stamp = {"epoch": state.epoch, "tick": state.tick, "robot_time": state.robot_time, "publish_time": 0.0}
            taken = TakeoverMessage(
                **stamp, service=service, change=message.change, fingerprint=message.fingerprint, state=answer,
                reason="no" if service == refuse else "",
            )  # fmt: skip
            self.node.hear("r1", taken)

    def until(self, condition):
        for _ in range(2500):
            self.tick()
            if condition():
                return
        raise AssertionError("it never came to that")

    def found(self, *effects):
        self.until(lambda: self.worker.busy("r1"))
        self.worker.ready = WorkOutcome(REPORT, effects, {"steering_offset": self.document})
        self.until(lambda: self.reported[-1].stage == "candidates")

    @property
    def document(self):
        return write_model(self.car.with_effect(effect("car", "steering_offset"), {"angle": Setting(0.08)}))

    def ask(self, do, name="", finding=1, model=""):
        request = Request(do=do, effect=name, model=model or self.node.model_of("r1"), finding=finding, who="Ada")
        return self.node.answer("r1", request)


@pytest.fixture
def driven(car, worker, drive_of, state_of, verdict_of):
    rows = drive_of(4000, CHANGE, "steering_offset", angle=0.08)
    return Driven(car, worker, rows, state_of, verdict_of)


def test_an_accepted_effect_is_prepared_on_the_newest_data_offered_and_taken(driven):
    driven.found("steering_offset", "steering_gain")
    assert driven.ask("status").candidates == ("steering_offset", "steering_gain")
    for _ in range(100):
        driven.tick()
    assert driven.ask("accept", "steering_offset").ok
    driven.tick()
    work = driven.worker.begun[-1]
    assert (work.task, work.effect, work.document) == ("prepare", "steering_offset", driven.document)
    assert work.run.t[-1] > driven.worker.begun[0].run.t[-1] + 4.0
    assert work.footprint == (0.08, 0.4, 0.12)
    driven.worker.ready = WorkOutcome(documents={"steering_offset": driven.document}, margin="{}")
    new = fingerprint(parse_model(driven.document))
    driven.until(lambda: driven.node.model_of("r1") == new)
    offer, take = driven.changes
    assert (offer.step, offer.fingerprint, offer.margin, offer.who) == ("offer", new, "{}", "Ada")
    assert "r1, 4" in offer.data
    assert take.step == "take"
    driven.until(lambda: driven.reported[-1].model == new)
    assert driven.reported[-1].stage == "learning"
    assert driven.ask("status").candidates == ()


def test_the_effect_of_accepting_is_reported_before_and_gives_way_to_an_accepted_candidate(
    car, worker, drive_of, state_of, verdict_of, margin_of
):
    rows = drive_of(4000, CHANGE, "steering_offset", angle=0.08)
    reported = {"margin": margin_of(0.05), "predict_effect": forecast_with("car")}
    driven = Driven(car, worker, rows, state_of, verdict_of, **reported)
    driven.found("steering_offset", "steering_gain")
    assert driven.ask("status").foreseen == ("", "")
    driven.until(lambda: worker.begun[-1].task == "prepare")
    assert worker.begun[-1].effect == "steering_offset"
    worker.ready = WorkOutcome(documents={"steering_offset": driven.document}, margin=margin_of(2.0))
    driven.until(lambda: worker.begun[-1].effect == "steering_gain")
    first, second = driven.ask("status").foreseen
    head, row = first.split("\n")
    assert head == "margin of | now | then | h now | takes effect"
    assert row.startswith("obstacle | 0.05 | 2 | 1 | at once it would stop")
    assert second == ""
    assert driven.changes == [], "nothing was offered to anybody"
    assert driven.ask("accept", "steering_offset").ok
    driven.tick()
    assert worker.begun[-1].effect == "steering_offset"
    worker.ready = WorkOutcome(documents={"steering_offset": driven.document}, margin=margin_of(0.21))
    new = fingerprint(parse_model(driven.document))
    driven.until(lambda: driven.node.model_of("r1") == new)
    assert driven.ask("status").earlier == 1


def test_a_foreseen_model_that_cannot_be_made_and_an_unchanged_margin_are_reported(margin_of):
    ahead, predict_effect = CandidateForecasts(), forecast_with("car")
    ahead.found = {
        "a": WorkOutcome(failure="too few rows"),
        "b": WorkOutcome(margin=margin_of(0.05)),
        "c": WorkOutcome(),
    }
    reported = ahead.reported(margin_of(0.05), predict_effect)
    assert reported["a"] == "its model cannot be created: too few rows"
    assert reported["b"] == "the margin stays as it is: obstacle 0.05"
    assert "no margin could be calibrated" in reported["c"]


@pytest.fixture
def margin_of():
    """A margin for obstacles, as text."""
    return lambda epsilon: margin_text(MarginCalibration({"obstacle": epsilon}, 0.99, 100, "2026-01-01", "aaaa"))


def test_a_refused_offer_leaves_the_model_and_the_finding(driven):
    driven.found("steering_offset")
    before = driven.node.model_of("r1")
    driven.ask("accept", "steering_offset")
    driven.tick()
    driven.worker.ready = WorkOutcome(documents={"steering_offset": driven.document}, margin="{}")
    for _ in range(30):
        driven.tick(refuse="policy")
    assert [message.step for message in driven.changes] == ["offer", "drop"]
    assert driven.node.model_of("r1") == before
    assert driven.reported[-1].stage == "candidates"
    assert driven.ask("status").candidates == ("steering_offset",)


def test_a_model_that_cannot_be_prepared_is_reported_and_not_offered(driven):
    driven.found("steering_offset", "steering_gain")
    driven.ask("accept", "steering_gain")
    driven.tick()
    assert driven.worker.begun[-1].document == ""
    driven.worker.ready = WorkOutcome(failure="runs: got 1 window")
    for _ in range(10):
        driven.tick()
    assert [message.step for message in driven.changes] == ["drop"]
    assert "got 1 window" in driven.changes[0].why


def test_when_every_candidate_is_rejected_the_error_is_usual_from_then_on(driven):
    driven.found("steering_offset", "steering_gain")
    assert driven.ask("reject", "steering_gain").ok
    driven.until(lambda: driven.reported[-1].stage == "candidates")
    assert driven.ask("reject", "steering_offset").ok
    driven.until(lambda: driven.reported[-1].stage == "watching")
    assert driven.reported[-1].number == 1
    assert not driven.ask("accept", "steering_offset").ok


def test_a_robot_that_leaves_takes_its_search_with_it_and_its_findings_go_on_counting(driven, car, drive_of):
    driven.until(lambda: driven.worker.busy("r1"))
    driven.node.forget("r1")
    assert driven.worker.cancelled == 1
    assert driven.node.diagnosis_of("r1") is None
    driven.rows = drive_of(2000, CHANGE, "steering_offset", angle=0.08)
    driven.until(lambda: driven.reported[-1].stage == "raised")
    assert driven.reported[-1].number == 2


@pytest.mark.parametrize(("values", "actions"), [(3, 2), (5, 2), (4, 1), (4, 3)])
def test_a_state_of_another_kind_of_robot_is_refused(driven, state_of, verdict_of, values, actions):
    state = state_of(next(driven.rows))
    other = replace(state, values=(0.0,) * values, applied=(0.0,) * actions)
    inputs = {LATENT: Stale(LATENT, None), VERDICT: verdict_of(state)}
    with pytest.raises(MessageError, match=f"got {values} values and {actions} actions, wanted those of a car"):
        driven.node.step("r1", other, inputs)
    assert driven.node.diagnosis_of("r1") is None
    driven.node.step("r1", state, inputs)


def test_a_broken_model_file_is_refused(worker):
    with pytest.raises(ModelFileError):
        DiagnosisNode("format = 1", worker)


@pytest.mark.parametrize("applied_by", ["filter", "watchdog"])
def test_a_search_gives_way_to_a_drive_that_misses_ticks(driven, state_of, verdict_of, applied_by):
    state = replace(state_of(next(driven.rows)), applied_by=applied_by)
    driven.node.step("r1", state, {LATENT: Stale(LATENT, None), VERDICT: verdict_of(state)})
    assert driven.worker.gave_way == (applied_by == "watchdog")
