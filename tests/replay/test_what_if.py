"""The same recorded states under another model, eta or margin; and driven again."""

from __future__ import annotations

from pathlib import Path

import pytest

from safedpa.dynamics import load_model
from safedpa.errors import InputError
from safedpa.replay.tape import Tape, read_tape
from safedpa.replay.what_if import Change, summary_of, what_if
from safedpa.safety.shipped import margin_for
from safedpa_sim.replayed import drive_again

GOLDEN = Path(__file__).parent / "golden"


@pytest.fixture(scope="module")
def box() -> Tape:
    return read_tape([GOLDEN / "car_box.mcap"])


def test_the_same_settings_decide_the_same(box: Tape) -> None:
    model = load_model("car")
    margin = margin_for(model)
    for change in (Change(), Change(model=model), Change(model=model, margin=margin)):
        decisions = what_if(box, change)
        assert len(decisions) == 120
        assert not any(decision.differs for decision in decisions)
        summary = summary_of(decisions)
        assert summary.status_then == summary.status_now
        assert summary.smallest_h_then == summary.smallest_h_other


def test_a_wider_margin_and_a_smaller_eta_correct_earlier(box: Tape) -> None:
    then = summary_of(what_if(box, Change()))
    wider, slower = summary_of(what_if(box, Change(margin=0.2))), summary_of(what_if(box, Change(eta=0.05)))
    for summary in (wider, slower):
        assert summary.status_now.get("passed", 0) < then.status_then["passed"]
        assert summary.smallest_h_now == then.smallest_h_now, "the states are the recorded ones"


def test_another_model_gets_latents_of_its_own(box: Tape) -> None:
    decisions = what_if(box, Change(model=load_model("car_learned")))
    assert {decision.now.model for decision in decisions} != {decision.then.model for decision in decisions}
    assert "fallback" not in {decision.now.status for decision in decisions}
    assert any(decision.now.h_next != decision.then.h_next for decision in decisions)


def test_stale_inputs_stay_stale_under_another_margin() -> None:
    tape = read_tape([GOLDEN / "car_killed.mcap"])
    summary = summary_of(what_if(tape, Change(margin=0.0)))
    assert summary.status_now["fallback"] == summary.status_then["fallback"] > 0


def test_only_the_stretch_asked_for_is_counted(box: Tape) -> None:
    assert summary_of(what_if(box, Change(eta=0.1), (1.0, 1.999))).ticks == 20
    with pytest.raises(InputError, match="without any verdict"):
        summary_of(what_if(box, Change(eta=0.1), (900.0, 901.0)))


def test_a_model_of_another_robot_and_a_margin_of_another_model_are_refused(box: Tape) -> None:
    with pytest.raises(InputError, match="2 states and 1 actions"):
        what_if(box, Change(model=load_model("pendulum")))
    with pytest.raises(InputError, match="calibrated for model"):
        what_if(box, Change(margin=margin_for(load_model("car_learned"))))


def test_the_same_drive_again_is_the_same_drive(box: Tape) -> None:
    driven = drive_again(box, Change())
    assert driven["apart_from_tick"] is None
    assert all(then == now for then, now in driven["compared"].values())


def test_under_another_eta_it_is_another_drive() -> None:
    tape = read_tape([GOLDEN / "pendulum.mcap"])
    driven = drive_again(tape, Change(eta=0.2))
    assert driven["ticks"] == 100
    assert driven["apart_from_tick"] == 2, "the states until the first action are the same"
    (then, now), passed = driven["compared"]["verdicts corrected"], driven["compared"]["verdicts passed"]
    assert now > then > 0, "a smaller eta corrects earlier"
    assert passed == (100 - then, 100 - now)


def test_without_the_robot_s_options_it_cannot_be_driven_again(box: Tape) -> None:
    tape = read_tape([GOLDEN / "car_box.mcap"])
    tape.setups.pop("robot")
    with pytest.raises(InputError, match="options of robot 'r1' are not in the recording"):
        drive_again(tape, Change())
