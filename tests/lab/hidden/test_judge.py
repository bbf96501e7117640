"""The judge of a diagnosis, and the figures made of its judgements."""

from __future__ import annotations

import json

import pytest

from safedpa_lab.experiments.hidden_summary import summary
from safedpa_lab.hidden import Case, truth_of
from safedpa_lab.hidden.case import TURNS_LESS, equals_of
from safedpa_lab.hidden.judge import judged
from safedpa_lab.hidden.towing import turning_share

DRAG = {"quadratic_drag": {"coefficient": 0.12}}


def document(added=(), verdict="effect_missing", groups=None, value=0.125, std=0.004, unexplained=None, error=0.02):
    accepted = [
        {
            "stage": stage,
            "effect": name,
            "parameters": {"coefficient": {"value": value, "std": std, "unit": "1/m"}},
            "indistinguishable_from": list((groups or {}).get(name, ())),
            "decision": "accepted",
        }
        for stage, name in enumerate(added)
    ]
    rejected = [{**item, "effect": "payload", "decision": "rejected"} for item in accepted]
    stages = [{"heldout_error": 0.1}, *[{"heldout_error": error}] * len(added)]
    return {
        "verdict": verdict,
        "added": list(added),
        "stages": stages,
        "candidates": [*rejected, *accepted],
        "unexplained": unexplained,
    }


def judge(case, found, oracle=0.02):
    return judged(case.name, found, json.loads(json.dumps(truth_of(case))), oracle, 1.5)


def test_the_hidden_effect_named_first():
    outcome = judge(Case("ordinary", 1, DRAG), document(["quadratic_drag", "payload"], error=0.021))
    assert outcome.right
    assert outcome.first_named
    assert outcome.wrong == ("payload",)
    assert outcome.deviations == pytest.approx((1.25,))
    assert outcome.error_ratio == pytest.approx(1.05)


ONE, NONE = Case("ordinary", 1, DRAG), Case("none", 1, {})
PAYLOAD = {"payload": {"mass_ratio": 0.3}}
CHAIR = Case("towing", 1, {"towed_load": {"mass_ratio": 0.8, "deceleration": 1.5}}, load="chair")


@pytest.mark.parametrize(
    ("case", "added", "verdict", "group", "right", "wrong"),
    [
        (ONE, ["viscous_drag"], "effect_missing", "", False, ("viscous_drag",)),
        (ONE, ["viscous_drag"], "effect_missing", "quadratic_drag", True, ()),
        (ONE, ["viscous_drag"], "effect_missing", "quadratic_drag + payload", True, ()),
        (NONE, [], "nothing_missing", "", True, ()),
        (NONE, [], "unexplained", "", False, ()),
        (NONE, ["payload"], "effect_missing", "", False, ("payload",)),
        (Case("hard", 1, PAYLOAD, hard=True), [], "nothing_missing", "", True, ()),
        (Case("ordinary", 1, PAYLOAD), [], "nothing_missing", "", False, ()),
        (CHAIR, ["towed_load", "steering_lag", "battery_sag"], "effect_missing", "", True, ("battery_sag",)),
    ],
    ids=[
        "another effect", "a group that is reported", "a pair that is reported", "nothing hidden", "unexplained",
        "false alarm", "taken up by a free gain", "missed", "what the pymunk car has by itself",
    ],
)  # fmt: skip
def test_an_answer_is_judged_by_what_is_hidden(case, added, verdict, group, right, wrong):
    outcome = judge(case, document(added, verdict, {added[0]: [group]} if group else None))
    assert (outcome.right, outcome.wrong) == (right, wrong)
    if case is ONE:
        assert not outcome.first_named
        assert not outcome.all_named
        assert outcome.deviations == ()


def test_equal_effects_must_be_reported_not_guessed():
    case = Case("hard", 1, {"viscous_drag": {"coefficient": 0.3}}, hard=True)
    assert equals_of(case, "viscous_drag") == ("speed_command_gain",)
    guessed = judge(case, document(["speed_command_gain"]))
    assert not guessed.right
    assert guessed.wrong == ()
    said = judge(case, document(["speed_command_gain"], groups={"speed_command_gain": ["viscous_drag"]}))
    assert said.right


@pytest.mark.parametrize(
    ("gain", "wrong"), [(0.98, ()), (0.95, ()), (0.92, ("steering_gain",)), (1.03, ("steering_gain",))]
)
def test_a_steering_gain_is_part_of_a_load_where_it_is_the_load_s(gain, wrong):
    found = document(["towed_load", "steering_gain"])
    found["parameters"] = {"steering_gain.gain": {"value": gain, "std": 0.01, "unit": "1"}}
    assert judge(CHAIR, found).wrong == wrong
    found["parameters"]["steering_gain.end"] = {"value": 0.1, "std": 0.01, "unit": "1"}
    assert judge(CHAIR, found).wrong == ("steering_gain",), "one that varies is another claim"
    bare = judge(Case("ordinary", 1, CHAIR.effects), found)
    assert bare.wrong == ("steering_gain",), "without a load there is none"


@pytest.mark.parametrize("load", TURNS_LESS)
def test_a_load_turns_less_by_one_share_at_every_speed(load):
    """Understeering would grow with the square of the speed."""
    found = [turning_share(load, wished, steer) for wished in (1.0, 1.5, 2.0) for steer in (0.1, 0.2)]
    speeds, shares = zip(*found, strict=True)
    assert max(speeds) > 2.0 * min(speeds)
    assert shares == pytest.approx([TURNS_LESS[load]] * len(shares), abs=0.012)
    assert turning_share("none", 1.5, 0.2)[1] == pytest.approx(1.0, abs=1e-3)


def test_a_law_must_have_the_right_direction():
    effects = {"rolling_resistance": {"deceleration": 1.0, "x_above": 0.5}}
    case = Case("patches", 1, effects, laws={"rolling_resistance": "where x above"})

    def said(words, border=0.55, effect="rolling_resistance", kind="where"):
        found = document([effect])
        found["parameters"] = {
            f"{effect}.{name}": {"value": value, "std": 0.02, "unit": ""}
            for name, value in (("deceleration", 1.05), ("x_above", border))
        }
        found["conditions"] = [{"effect": effect, "kind": kind, "words": words}] if words else []
        return judge(case, found)

    assert said("x above").right
    assert said("x above").deviations == pytest.approx((2.5, 2.5))
    for wrong in (said("x below"), said(""), said("x above", border=0.8), said("x above", kind="varies")):
        assert not wrong.right
    plain = judge(Case("ordinary", 1, DRAG), {**document(["quadratic_drag"]), "conditions": [
        {"effect": "quadratic_drag", "kind": "varies", "words": "coefficient with time"}]})  # fmt: skip
    assert plain.right
    assert plain.false_laws == ("quadratic_drag varies coefficient with time",)


def test_the_summary_counts():
    case = Case("ordinary", 1, DRAG)
    outcomes = [
        judge(case, document(["quadratic_drag"], value=0.121)),
        judge(case, document(["quadratic_drag"], value=0.14, error=0.03)),
        judge(case, document((), "nothing_missing", error=0.1)),
        judge(Case("none", 1, {}), document((), "nothing_missing"), None),
    ]
    found = summary(["ordinary", "none"], outcomes)
    ordinary, none = found["suites"]
    assert (ordinary["right"]["hits"], ordinary["right"]["of"]) == (2, 3)
    assert ordinary["parameters_within_two"] == {"hits": 1, "of": 2, "interval_95": pytest.approx([0.0945, 0.9055])}
    assert (ordinary["error_ratio_within"]["hits"], ordinary["error_ratio_within"]["of"]) == (1, 3)
    assert ordinary["error_ratio_largest"] == pytest.approx(5.0)
    assert none["named_first"] is None
    assert none["error_ratio_median"] is None
    assert none["right"]["hits"] == 1
    assert [row["effect"] for row in found["effects"]] == ["quadratic_drag"]
    assert [item["verdict"] for item in found["missed"]] == ["nothing_missing"]
    json.dumps(found)
