"""A finding that is put together by hand: its sentence in each stage, what is kept of a drive, and who is paused."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from safedpa.bus import LATENT, VERDICT
from safedpa.dynamics import PhysicsModel, load_model, write_model
from safedpa.errors import MessageError
from safedpa.live.finding import History, RobotDiagnosis, _Adopted, _Finding
from safedpa.live.node import DiagnosisNode
from safedpa.live.watch import Band
from safedpa.live.work import WorkOutcome

CAR = load_model("car")
BAND = Band(scale=np.ones(4), usual=np.ones(2), edges=np.ones(4), error=0.25)


@pytest.fixture
def diagnosis(car: PhysicsModel, worker: Any) -> RobotDiagnosis:
    return RobotDiagnosis("r1", write_model(car), worker, number=7)


ERROR = "the error over 1 s is 0.000"


def test_without_a_finding_the_band_is_told_and_how_long_it_is_still_learned(diagnosis: RobotDiagnosis) -> None:
    """From 20 s of driving."""
    assert diagnosis._sentence("learning") == f"{ERROR}; still learning what is usual: 20 s of driving to go"
    diagnosis.watch.band = BAND
    assert diagnosis._sentence("watching") == f"{ERROR}, within its band up to 0.250"


@pytest.mark.parametrize(
    ("finding", "told"),
    [
        (_Finding(0), "0 of 15 s are recorded for the search"),
        (_Finding(0, 30.0), "0 of 30 s are recorded for the search"),
        (_Finding(0, 30.0, searching=True), "looking for the missing effect in 30 s of driving"),
        (_Finding(0, 30.0, outcome=WorkOutcome("")), "no effect of the library explains it"),
        (_Finding(0, 30.0, outcome=WorkOutcome(failure="it died")), "the search failed: it died"),
    ],
)
def test_with_a_finding_what_is_done_about_it_is_told(diagnosis: RobotDiagnosis, finding: _Finding, told: str) -> None:
    diagnosis.watch.band, diagnosis._finding = BAND, finding
    assert diagnosis._sentence("") == f"finding 7: {ERROR}, its band ends at 0.250; {told}"


def _entry(error: float | None, decision: str, stage: int = 0, effect: str = "drag") -> dict[str, Any]:
    return {"stage": stage, "effect": effect, "heldout_error": error, "decision": decision}


@pytest.mark.parametrize(
    "entries",
    [
        [_entry(None, "rejected"), _entry(0.3, "accepted")],
        [_entry(0.3, "accepted"), _entry(0.2, "rejected")],
        [_entry(float("nan"), "rejected"), _entry(0.3, "rejected")],
        [_entry(0.7, "rejected"), _entry(0.3, "rejected"), _entry(None, "rejected")],
        [_entry(0.1, "accepted", stage=1), _entry(0.1, "accepted", effect="lag"), _entry(0.3, "accepted")],
    ],
)
def test_of_entries_with_one_name_the_accepted_or_best_one_is_told(
    diagnosis: RobotDiagnosis, entries: list[dict[str, Any]]
) -> None:
    """As it is and under a condition an effect has one name."""
    report = {"stages": [{"heldout_error": 0.9}], "candidates": entries}
    outcome = WorkOutcome(json.dumps(report), ("drag",), {"drag": "a model"})
    diagnosis.watch.band, diagnosis._finding = BAND, _Finding(0, 30.0, outcome=outcome)
    assert "drag explains it: held-out error 0.900 without, 0.300 with it" in diagnosis._sentence("")


@pytest.mark.parametrize("entries", [[], [_entry(None, "rejected")]])
def test_an_effect_without_an_error_is_told_without_one(
    diagnosis: RobotDiagnosis, entries: list[dict[str, Any]]
) -> None:
    report = {"stages": [{"heldout_error": None}], "candidates": entries}
    diagnosis.watch.band, diagnosis._finding = (
        BAND,
        _Finding(0, 30.0, outcome=WorkOutcome(json.dumps(report), ("drag",))),
    )
    assert diagnosis._sentence("").endswith(
        "drag may explain it, but unseen data do not confirm it: held-out error unknown without, unknown with it"
    )


@pytest.mark.parametrize(("open_", "told"), [(False, True), (True, False)])
def test_beside_an_open_finding_the_model_before_is_no_longer_told(
    diagnosis: RobotDiagnosis, open_: bool, told: bool
) -> None:
    diagnosis.watch.band, diagnosis._adopted, diagnosis.time = BAND, _Adopted(100.0, 0.5), 101.0
    diagnosis._finding = _Finding(0) if open_ else None
    assert ("0.500 with the model before" in diagnosis._sentence("")) is told


WORK: Any = "a model is made"


@pytest.mark.parametrize("finding", [None, _Finding(0), _Finding(0, outcome=WorkOutcome(""))])
def test_where_no_search_goes_on_the_worker_is_left_alone(
    diagnosis: RobotDiagnosis, worker: Any, finding: _Finding | None
) -> None:
    """It may be making a model for the robot."""
    worker.begin("r1", WORK)
    diagnosis._finding = finding
    diagnosis.pause()
    assert (worker.cancelled, worker.busy("r1")) == (0, True)


def test_a_search_that_is_given_up_may_be_begun_anew_and_is_given_up_once(
    diagnosis: RobotDiagnosis, worker: Any
) -> None:
    worker.begin("r1", WORK)
    diagnosis._finding = _Finding(0, searching=True)
    assert diagnosis.stage == "searching"
    diagnosis.pause()
    assert (worker.cancelled, diagnosis.stage) == (1, "raised")
    worker.begin("r1", WORK)
    diagnosis.pause()
    assert (worker.cancelled, diagnosis.stage) == (1, "raised")


@pytest.mark.parametrize(
    ("state", "applied", "kept"),
    [
        ((0.0, 0.0, 0.0, 1.0), (1.0, 0.1), True),
        ((0.0, np.nan, 0.0, 1.0), (1.0, 0.1), False),
        ((0.0, 0.0, 0.0, 1.0e9), (1.0, 0.1), False),
        ((0.0, 0.0, 0.0, 1.0), (1.0, np.inf), False),
        ((0.0, 0.0, 0.0, 1.0), (np.nan, 0.1), False),
    ],
)
def test_a_tick_that_cannot_be_believed_is_a_gap_in_what_is_kept(
    state: tuple[float, ...], applied: tuple[float, ...], kept: bool
) -> None:
    history = History(CAR.system, 0.5)
    for tick in range(9):
        usual = tick != 4
        history.add(
            tick, np.array((0.0, 0.0, 0.0, 1.0) if usual else state), np.array((1.0, 0.1) if usual else applied)
        )
    run = history.excerpt(0, "r1")
    assert [len(part) for part in run.stretches] == ([8] if kept else [3, 3])
    assert run.t.tolist() == [0.5 * tick for tick in range(9) if kept or tick != 4]


@pytest.mark.parametrize(("states", "actions"), [(3, 2), (5, 2), (4, 1), (4, 3)])
def test_a_robot_of_another_kind_is_refused(
    states: int, actions: int, car: PhysicsModel, worker: Any, state_of: Any
) -> None:
    node = DiagnosisNode(write_model(car), worker)
    state = state_of((0, np.zeros(4), np.zeros(2)))
    other = replace(state, values=(0.0,) * states, applied=(0.0,) * actions)
    inputs: Any = {LATENT: None, VERDICT: None}
    with pytest.raises(MessageError, match=f"got {states} values and {actions} actions, wanted those of a car"):
        node.step("r1", other, inputs)
    assert node.diagnosis_of("r1") is None
    node.step("r1", state, inputs)
