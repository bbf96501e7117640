"""The trial of an offered model: the service has to answer, and its ticks must fit into the period."""

import argparse
import time
from typing import Any

import pytest
from tests.messages import STAMP, state_of

from safedpa.adaptation import AdaptationNode
from safedpa.bus import TAKEOVER, ModelMessage, TakeoverMessage
from safedpa.dynamics import fingerprint, load_model, parse_model, write_model
from safedpa.errors import InputError
from safedpa_services.model_trial import run_model_trial

DOCUMENT = write_model(load_model("car")) + '\n[[effects]]\nname = "steering_offset"\nangle = 0.01\n'
NEW = fingerprint(parse_model(DOCUMENT))
OFFER = ModelMessage(**STAMP, step="offer", change=4, fingerprint=NEW, replaces="", document=DOCUMENT, margin="")
STATE = state_of(tick=70, robot_time=3.5, period=0.05)
WORK = ("adaptation", argparse.Namespace(model="car", orders=""), "r1", OFFER, STATE, None)


@pytest.fixture
def reported(monkeypatch):
    """Ticks and messages that the service received, in order; a message as its step and its first tick."""
    seen: list[Any] = []
    step, hear = AdaptationNode.step, AdaptationNode.hear

    def stepped(self, robot, state, inputs):
        assert state.robot_time == pytest.approx(0.05 * state.tick)
        seen.append(state.tick)
        return step(self, robot, state, inputs)

    def heard(self, robot, message):
        seen.append((message.step, message.from_tick))
        hear(self, robot, message)

    monkeypatch.setattr(AdaptationNode, "step", stepped)
    monkeypatch.setattr(AdaptationNode, "hear", heard)
    return seen


@pytest.mark.parametrize(
    ("milliseconds", "usual"),
    [
        ([12.0] * 10, None),
        ([13.0] * 10, "13.0"),
        ([1.0] * 6 + [500.0] * 4, None),  # what else the machine does
        ([1.0] * 4 + [20.0] * 6, "20.0"),
    ],
)
def test_a_tick_with_an_offered_model_may_usually_take_a_quarter_of_the_period(
    reported, milliseconds, usual, monkeypatch
):
    """The median CPU time of ten ticks at 20 Hz. The model is offered at one tick and taken at the next."""
    now, costs, step = [0.0], list(milliseconds), AdaptationNode.step
    monkeypatch.setattr(time, "process_time", lambda: now[0])

    def costly(self, robot, state, inputs):
        if self.model_of(robot) == NEW or ("take", 72) in reported:
            now[0] += 1e-3 * costs.pop(0)
        return step(self, robot, state, inputs)

    monkeypatch.setattr(AdaptationNode, "step", costly)
    if usual is None:
        assert fingerprint(parse_model(run_model_trial(WORK)["document"])) == NEW
    else:
        with pytest.raises(InputError, match=rf"takes {usual} ms of CPU time, wanted at most 12\.5 ms, 25%"):
            run_model_trial(WORK)
    assert reported == [70, ("offer", 0), 71, ("take", 72), *range(72, 82)]
    assert costs == []


@pytest.mark.parametrize(("answer", "notice"), [(None, "the service gave no answer"), ("refused", "it does not fit")])
def test_the_trial_ends_when_the_service_refuses_or_does_not_answer(reported, answer, notice, monkeypatch):
    message = TakeoverMessage(
        **STAMP, service="adaptation", change=4, fingerprint=NEW, state=answer or "", reason="it does not fit"
    )
    monkeypatch.setattr(AdaptationNode, "afterwards", lambda *_: {} if answer is None else {TAKEOVER: message})
    with pytest.raises(InputError, match=rf"^{notice}$"):
        run_model_trial(WORK)
    assert reported == [70, ("offer", 0), 71]
