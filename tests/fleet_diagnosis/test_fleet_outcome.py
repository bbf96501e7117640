"""What a fleet takes from a robot's report."""

from __future__ import annotations

import math

import pytest

from safedpa.fleet.outcome import neutral_of, outcome_of
from safedpa.fleet.story import common_sentence, discovery_sentence, listed, range_text

RESULT = {"robot": "car_1", "status": "diagnosed", "reason": "", "unreadable_files": [{"path": "x", "reason": "y"}]}


def candidate(stage, effect, score, decision="rejected", equals=(), **parameters):
    numbers = {name: {"value": value, "std": std, "unit": "1"} for name, (value, std) in parameters.items()}
    return {
        "stage": stage, "effect": effect, "parameters": numbers, "heldout_error": 0.1, "score": score,
        "indistinguishable_from": list(equals), "decision": decision, "reason": "",
    }  # fmt: skip


def report(*candidates, added=(), parameters=(), **more):
    return {
        "robot": "car", "added": list(added), "candidates": list(candidates), "unexplained": None,
        "stages": [{"heldout_error": 0.3}, {"heldout_error": 0.1}], "data_quality": [{"message": "a"}] * 2,
        "parameters": {path: {"value": value, "std": std, "unit": "1"} for path, value, std in parameters},
    } | more  # fmt: skip


def test_the_final_numbers_of_what_was_found_and_its_rivals_of_the_same_stage():
    found = outcome_of(
        RESULT,
        report(
            candidate(0, "payload", 6.0, "accepted", ("towed_load", "a + b"), mass_ratio=(0.3, 0.01)),
            candidate(0, "towed_load", 5.5, mass_ratio=(0.4, 0.02)),
            candidate(0, "a + b", 5.0),
            candidate(1, "towed_load", 0.1, mass_ratio=(0.0, 0.02)),
            candidate(1, "understeer", 0.7, gradient=(0.001, 0.001)),
            added=["payload"],
            parameters=[("payload.mass_ratio", 0.31, 0.005), ("base.speed_gain", 3.1, 0.1)],
        ),
    )
    (payload,) = found.found
    assert payload.numbers["mass_ratio"].value == 0.31
    assert payload.equals == ("towed_load",)
    assert payload.others["towed_load"].numbers["mass_ratio"].value == 0.4
    assert found.evidence == 6.0
    assert found.trials == 3
    assert set(found.last) == {"towed_load", "understeer"}
    assert found.free["base.speed_gain"].value == 3.1
    assert (found.error_before, found.error_after, found.unread, found.findings) == (0.3, 0.1, 1, 1)
    assert found.judged


@pytest.mark.parametrize(("score", "std", "evidence"), [(4.0, 0.001, 4.0), (2.0, 0.01, 10.0), (2.0, 0.1, 2.0)])
def test_where_blocks_did_not_decide_the_filters_deviations_count_a_third(score, std, evidence):
    accepted = candidate(0, "payload", score, "accepted", mass_ratio=(0.3, 0.01))
    found = outcome_of(RESULT, report(accepted, added=["payload"], parameters=[("payload.mass_ratio", 0.3, std)]))
    assert found.evidence == pytest.approx(evidence)


def test_where_nothing_was_found_the_best_candidate_is_reported():
    found = outcome_of(RESULT, report(candidate(0, "payload", 1.2), candidate(0, "understeer", None)))
    assert (found.found, found.evidence) == ((), 1.2)
    assert math.isnan(found.last["understeer"].score)


def test_a_pair_is_found_effect_by_effect():
    pair = candidate(0, "drive_dead_zone + viscous_drag", 5.0, "accepted")
    numbers = [("drive_dead_zone.width", 0.1, 0.01), ("viscous_drag.coefficient", 0.3, 0.01)]
    found = outcome_of(RESULT, report(pair, added=["drive_dead_zone", "viscous_drag"], parameters=numbers))
    assert [(item.effect, list(item.numbers), item.score) for item in found.found] == [
        ("drive_dead_zone", ["width"], 5.0),
        ("viscous_drag", ["coefficient"], 5.0),
    ]


def test_what_was_rejected_again_later_does_not_speak_for_what_was_found():
    """The candidate of a found effect is the one that was accepted, whatever was said of it afterwards."""
    first = candidate(0, "payload", 6.0, "accepted", ("towed_load",), mass_ratio=(0.3, 0.01))
    again = candidate(1, "payload", 0.4, "rejected", ("understeer",), mass_ratio=(0.2, 0.01))
    numbers = [("payload.mass_ratio", 0.31, 0.005)]
    found = outcome_of(RESULT, report(first, again, added=["payload"], parameters=numbers))
    assert [(item.score, item.equals) for item in found.found] == [(6.0, ("towed_load",))]


def test_without_a_report_there_is_a_status_and_a_reason():
    found = outcome_of(RESULT | {"status": "unreadable", "reason": "empty"}, None)
    assert (found.status, found.reason, found.judged) == ("unreadable", "empty", False)


def test_where_an_effect_does_nothing():
    assert neutral_of("car", "steering_gain", "gain") == 1.0
    assert neutral_of("car", "payload", "mass_ratio") == 0.0
    assert neutral_of("car", "no_such_effect", "x") is None


def test_sentences():
    assert range_text({"low": 0.4, "high": 0.5, "unit": "m/s2"}) == "0.4 to 0.5 m/s2"
    assert range_text({"low": 0.4, "high": 0.4, "unit": "1"}) == "0.4"
    assert listed([str(i) for i in range(9)], 4) == "0, 1, 2 and 6 more"
    assert common_sentence({"common": None}) == ""
    found = {"judged": 300, "found": 7, "believed": 6, "share": 0.05}
    assert discovery_sentence({"false_discovery": found}).endswith(", 1 is suspected only.")
    assert discovery_sentence({"false_discovery": found | {"found": 0}}) == ""
