"""The judge of a diagnosis, the figures made of its judgements, their record and their page."""

import json
import re
from collections import Counter
from dataclasses import replace

import pytest

from safedpa.errors import InputError
from safedpa_lab.experiments.diagnosis import hidden_effects
from safedpa_lab.experiments.diagnosis.hidden_effects import (
    document_of,
    hidden_effects_experiment,
    page_of,
    read_outcomes,
    write_document,
)
from safedpa_lab.hidden import Case, truth_of
from safedpa_lab.hidden.case import TURNS_LESS, equals_of
from safedpa_lab.hidden.judge import Found, Outcome, judged
from safedpa_lab.hidden.towing import turning_share
from safedpa_lab.provenance.record import CONTENT, KEY, content_digest

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
        "verdict": verdict, "added": list(added), "stages": stages, "candidates": [*rejected, *accepted],
        "unexplained": unexplained,
    }  # fmt: skip


def judge(case, found, oracle=0.02):
    return judged(case.name, found, json.loads(json.dumps(truth_of(case))), oracle, 1.5)


def test_the_hidden_effect_named_first():
    outcome = judge(Case("ordinary", 1, DRAG), document(["quadratic_drag", "payload"], error=0.021))
    assert outcome.right
    assert outcome.first_named
    assert outcome.wrong == ("payload",)
    assert (outcome.deviations, outcome.error_ratio) == (pytest.approx((1.25,)), pytest.approx(1.05))


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
    notice = judge(case, document(["speed_command_gain"], groups={"speed_command_gain": ["viscous_drag"]}))
    assert notice.right


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
    found = [turning_share(load, nominal_speed, steer) for nominal_speed in (1.0, 1.5, 2.0) for steer in (0.1, 0.2)]
    speeds, shares = zip(*found, strict=True)
    assert max(speeds) > 2.0 * min(speeds)
    assert shares == pytest.approx([TURNS_LESS[load]] * len(shares), abs=0.012)
    assert turning_share("none", 1.5, 0.2)[1] == pytest.approx(1.0, abs=1e-3)


def test_a_law_must_have_the_right_direction():
    effects = {"rolling_resistance": {"deceleration": 1.0, "x_above": 0.5}}
    case = Case("patches", 1, effects, laws={"rolling_resistance": "where x above"})

    def notice(phrase, border=0.55, effect="rolling_resistance", kind="where"):
        found = document([effect])
        found["parameters"] = {
            f"{effect}.{name}": {"value": value, "std": 0.02, "unit": ""}
            for name, value in (("deceleration", 1.05), ("x_above", border))
        }
        found["conditions"] = [{"effect": effect, "kind": kind, "phrase": phrase}] if phrase else []
        return judge(case, found)

    assert notice("x above").right
    assert notice("x above").deviations == pytest.approx((2.5, 2.5))
    for wrong in (notice("x below"), notice(""), notice("x above", border=0.8), notice("x above", kind="varies")):
        assert not wrong.right
    plain = judge(Case("ordinary", 1, DRAG), {**document(["quadratic_drag"]), "conditions": [
        {"effect": "quadratic_drag", "kind": "varies", "phrase": "coefficient with time"}]})  # fmt: skip
    assert plain.right
    assert plain.false_laws == ("quadratic_drag varies coefficient with time",)


DRAG_RECORD = Outcome(
    suite="ordinary", case="ordinary-quadratic_drag-1", hidden=("quadratic_drag",), added=("quadratic_drag",),
    verdict="effect_missing", first_named=True, all_named=True, all_in_group=True, wrong=(),
    parameters=(Found("quadratic_drag.coefficient", 0.1208, 0.0005, 0.12),), error=0.011, error_ratio=1.02,
    seconds=9.0, processor_seconds=6.0,
)  # fmt: skip
ALARM = replace(
    DRAG_RECORD, suite="none", case="none-nothing-2", hidden=(), added=("payload",), wrong=("payload",), parameters=(),
    error_ratio=float("nan"),
)  # fmt: skip


def test_the_record_holds_what_was_judged(tmp_path):
    path = tmp_path / "record.json"
    write_document(document_of([DRAG_RECORD, ALARM], [7, 7]), path)
    document = json.loads(path.read_text())
    assert document["seeds"] == [7]
    assert {"python", "safedpa", "numpy"} <= set(document["versions"])
    assert document["date"].startswith("20")
    first, second = document["cases"]
    assert first["right"]
    assert first["parameters"][0]["deviation"] == pytest.approx(1.6)
    assert not second["right"]
    assert second["error_ratio"] is None
    outcomes, seeds = read_outcomes(path)
    assert (seeds, outcomes[0]) == ([7], DRAG_RECORD)
    assert repr(outcomes[1]) == repr(ALARM)  # NaN is not equal to itself


def test_an_interrupted_experiment_goes_on(tmp_path, monkeypatch):
    asked = []

    def judged(cases):
        asked.extend(case.name for case in cases)
        return [replace(DRAG_RECORD, suite=case.suite, case=case.name, hidden=tuple(case.effects)) for case in cases]

    monkeypatch.setattr(hidden_effects, "run_cases", judged)
    path = tmp_path / "record.json"
    first = hidden_effects_experiment(["ordinary"], 2, 3, processes=1, record=path)
    reported = []
    more = hidden_effects_experiment(
        ["ordinary", "none"], 3, 3, processes=1, record=path, report_progress=lambda *counts: reported.append(counts)
    )
    assert len(asked) == len(set(asked)) == 6
    assert reported[-1] == (4, 4)
    names = {row["case"] for row in more["cases"]}
    assert {row["case"] for row in first["cases"]} < names
    retained = json.loads(path.read_text())
    assert retained.pop("provenance")["date"]
    assert (retained, [row["cases"] for row in more["suites"]]) == (more, [3, 3])
    again = hidden_effects_experiment(["none"], 3, 3, processes=1, record=path)
    assert (again["cases"], again["seeds"]) == (more["cases"], [3])


@pytest.mark.parametrize(
    ("change", "notice"),
    [
        ({"code": {"safedpa.safety": "0" * 12}}, "made by other code than today's"),
        ({"command": "safedpa experiment hidden-effects --seed 5"}, "was made by"),
        ({"content": "0" * 16}, "was edited since it was made"),
    ],
)
def test_cases_of_other_code_or_another_command_are_not_continued(tmp_path, change, notice):
    path = tmp_path / "record.json"
    write_document(document_of([DRAG_RECORD], [7]), path)
    document = json.loads(path.read_text())
    document[KEY] |= change
    if "content" not in change:
        document[KEY][CONTENT] = content_digest(document)
    path.write_text(json.dumps(document))
    with pytest.raises(InputError, match=notice):
        read_outcomes(path)
    del document[KEY]
    path.write_text(json.dumps(document))
    with pytest.raises(InputError, match="has no provenance"):
        read_outcomes(path)


@pytest.mark.parametrize("text", ["{", "[]", '{"experiment": "car"}', '{"experiment": "hidden-effects", "cases": []}'])
def test_another_file_is_no_record(tmp_path, text):
    path = tmp_path / "other.json"
    path.write_text(text)
    with pytest.raises(InputError, match=r"other\.json.*name a new file"):
        hidden_effects_experiment(["none"], 1, processes=1, record=path)
    assert path.read_text() == text


def test_the_page_has_every_figure():
    page = page_of(document_of([DRAG_RECORD, ALARM], [7, 8]))
    rows = [line for line in page.splitlines() if line.startswith("|")]
    assert len({line.count("|") for line in rows[:4]}) == 1
    suite = [cell.strip() for cell in next(line for line in rows if line.startswith("| ordinary")).split("|")[1:-1]]
    assert suite[:7] == ["ordinary", "1", "100", "21 to 100", "100", "100", "0"]
    assert suite[7:] == ["0", "100", "1.020", "1.020", "100", "9.0", "9.0", "6.0", "6.0"]
    assert "- `none-nothing-2`: hidden nothing; effect_missing, added payload" in page
    assert re.search(r"^2 cases, seeds 7, 8; finished 20\d\d-", page, re.MULTILINE), page


@pytest.mark.parametrize(
    "cases", [[DRAG_RECORD], [ALARM, DRAG_RECORD, DRAG_RECORD], [DRAG_RECORD, ALARM, ALARM, DRAG_RECORD]]
)
def test_the_cases_of_the_page_are_those_of_its_suites_and_of_its_list(cases):
    document = document_of([replace(case, case=f"{case.case}{at}") for at, case in enumerate(cases)], [7])
    page = page_of(document)
    assert int(re.search(r"^(\d+) cases", page, re.MULTILINE)[1]) == len(cases)
    begun = page[page.index("## By suite") : page.index("## By effect") if "## By effect" in page else None]
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in begun.splitlines() if line.startswith("|")]
    reported = {row[0]: int(row[1]) for row in rows[2:]}
    assert {name: reported[name] for name in {case.suite for case in cases}} == Counter(case.suite for case in cases)
    wrong = sum(case.suite == "none" for case in cases)
    assert page.partition("## Missed")[2].count("\n- `") == wrong


def test_a_page_without_a_miss_says_none():
    assert page_of(document_of([DRAG_RECORD], [7])).endswith("\n\nNone.\n")
