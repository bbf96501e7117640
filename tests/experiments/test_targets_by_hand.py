"""What diagnoses of recordings, of hidden effects and of fleets come to, from records that are written down by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa_lab.experiments import fleet_diagnosis, fleet_screen, hidden_summary, real_logs
from safedpa_lab.experiments.fleet_diagnosis import judged_fleet
from safedpa_lab.experiments.hidden_page import page_of as hidden_page
from safedpa_lab.experiments.real_logs_targets import folds_target, targets_of
from safedpa_lab.experiments.statistics import wilson_interval


@pytest.mark.parametrize(
    ("errors", "together"), [([(4.0, 1.0), (2.0, 1.0), (2.0, 0.5)], -0.6875), ([(1.0, 2.0)], 1.0), ([], None)]
)
def test_errors_of_the_logs_that_were_left_out_are_added_up(
    errors: list[tuple[float, float]], together: float | None
) -> None:
    rows = [{"unseen_before": before, "unseen_after": after} for before, after in errors]
    assert real_logs._together(rows) == together


def test_how_often_an_effect_was_added_is_counted_most_frequent_first() -> None:
    rows: list[dict[str, Any]] = [
        {"added": ["a"]},
        {"added": ["b", "a"]},
        {"added": []},
        {"added": ["b"]},
        {"added": ["c", "b"]},
    ]
    assert list(real_logs._stable(rows).items()) == [("b", 3), ("a", 2), ("c", 1)]


@pytest.mark.parametrize(("errors", "change"), [((4.0, 3.0, 1.0), -0.75), ((0.0, 0.0), 0.0), ((2.0,), 0.0)])
def test_the_change_of_the_error_is_from_the_first_stage_to_the_last(
    errors: tuple[float, ...], change: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    def accepted(effect: str, decision: str, *alike: str) -> Any:
        return SimpleNamespace(effect=effect, decision=decision, indistinguishable_from=alike)

    stages = [SimpleNamespace(heldout_error=error, runs_improved=n) for n, error in enumerate(errors)]
    report: Any = SimpleNamespace(
        stages=stages, parameters={"a.x": SimpleNamespace(value=1.23456, std=None),
                                   "a.y": SimpleNamespace(value=2.0, std=0.123456)},
        candidates=[accepted("a", "accepted", "b"), accepted("c", "accepted"), accepted("d", "rejected", "e")],
        verdict="model", added=("a",), unexplained=None,
    )  # fmt: skip
    monkeypatch.setattr(real_logs, "as_document", lambda _: None)
    monkeypatch.setattr(real_logs, "story_of", lambda _: SimpleNamespace(lead="so"))
    found = real_logs._summary(report)
    assert (found["change"], found["errors"]) == (change, list(errors))
    assert found["runs_improved"] == list(range(1, len(errors)))
    assert found["parameters"] == {"a.x": [1.235, None], "a.y": [2.0, 0.1235]}
    assert found["indistinguishable"] == {"a": ["b"]}


@pytest.mark.parametrize(
    ("row", "measured", "met"),
    [
        ({"name": "", "added": ["a", "b", "c"], "change": -0.6}, "-60.0 % with 3 effects", True),
        ({"name": "", "added": ["a"], "change": -0.59}, "-59.0 % with 1 effects", False),
        ({"name": "x10-11-12.csv", "added": ["a", "b"], "unseen_change": -0.3, "verdict": "model"},
         "-30.0 % with 2 effects", True),
        ({"name": "x10-11-12.csv", "added": [], "unseen_change": -0.29, "verdict": "model"},
         "-29.0 % with 0 effects", False),
        ({"name": "x10-11-12.csv", "added": [], "unseen_change": 0.5, "verdict": "undecided"}, "undecided", True),
    ],
)  # fmt: skip
def test_targets_of_the_car(row: dict[str, Any], measured: str, met: bool) -> None:
    (found,) = targets_of([{"part": "car", **row}])
    assert (found["measured"], found["met"]) == (measured, met)
    assert found["subject"] == ("car, without 10-11-12" if row["name"] else "car, all logs")


@pytest.mark.parametrize(("after", "met"), [(1.4, True), (1.42, False)])
def test_a_target_where_it_is_told_that_it_holds(after: float, met: bool) -> None:
    row = {
        "part": "car", "name": "10-11-12.csv", "added": [], "unseen_change": 0.0, "verdict": "model",
        "unseen_told": 0.25, "unseen_where_told": (2.0, after),
    }  # fmt: skip
    found = targets_of([row])[1]
    assert (found["measured"], found["met"]) == (f"{50 * after - 100:+.1f} %; 25 % of its predictions lie there", met)


@pytest.mark.parametrize(
    ("added", "errors", "met", "measured"),
    [
        (["coulomb_friction"], [2.0, 1.09, 0.5], [True, True, True], ["coulomb_friction", "-45.5 %", "none"]),
        (["coulomb_friction", "torque_lag"], [2.0, 1.2], [True, False, False], ["", "-40.0 %", "torque_lag"]),
        (["drag", "torque_delay", "torque_offset"], [2.0, 1.0], [False, True, False],
         ["drag", "-50.0 %", "torque_delay, torque_offset"]),
        ([], [2.0], [False, False, True], ["nothing", "+0.0 %", "none"]),
    ],
)  # fmt: skip
def test_targets_of_the_pendulum(added: list[str], errors: list[float], met: list[bool], measured: list[str]) -> None:
    found = targets_of([{"part": "pendulum", "added": added, "errors": errors}])
    assert [one["met"] for one in found] == met
    for one, said in zip(found, measured, strict=True):
        assert said in one["measured"]


@pytest.mark.parametrize(
    ("name", "added", "met"),
    [
        ("Bowling", [], True), ("bowling 2", ["drag"], False), ("Whiffle", ["quadratic_drag", "wind"], True),
        ("whiffle", ["wind", "quadratic_drag"], False), ("whiffle", [], False), ("tennis", ["drag"], None),
    ],
)  # fmt: skip
def test_targets_of_the_balls(name: str, added: list[str], met: bool | None) -> None:
    found = targets_of([{"part": "balls", "name": name, "added": added, "verdict": "nothing"}])
    assert [one["met"] for one in found] == ([] if met is None else [met])


@pytest.mark.parametrize(("change", "met"), [(-0.6, True), (-0.5999, False), (0.1, False)])
def test_the_target_of_all_logs_together(change: float, met: bool) -> None:
    assert folds_target(change)["met"] is met


def test_limits_of_a_screen_are_of_the_healthy_cars_of_the_same_drive(monkeypatch: pytest.MonkeyPatch) -> None:
    """Errors of healthy cars rise from 1; those of the effects behind them are told over the limit of their own."""
    cases: list[Any] = []

    def errors(found: Any, _: Any) -> list[float]:
        cases.extend(found)
        return [float(n + 1) for n in range(len(found))]

    monkeypatch.setattr(fleet_screen, "_errors", errors)
    told = fleet_screen.fleet_screen(0, 6)
    healthy, ill = cases[:6], cases[6:]
    assert all(not case.effects for case in healthy)
    assert (told["healthy"], told["effects"]) == (6, len(ill))
    assert {row["effect"]: row["error"] for row in told["rows"]} == {
        next(iter(case.effects)): 7.0 + n for n, case in enumerate(ill)
    }
    for drive, limit in told["limits"].items():
        own = [n + 1.0 for n, case in enumerate(healthy) if case.drive == drive]
        assert len(own) == 6 // len(told["limits"])
        assert limit == pytest.approx(float(np.quantile(own, told["quantile"])))
    assert told["missed"] == [row["effect"] for row in told["rows"] if row["over_limit"] <= 1.0] == []


def hidden(suite: str, case: str, *effects: str, right: bool = True, wrong: tuple[str, ...] = ()) -> Any:
    return SimpleNamespace(
        suite=suite, case=case, hidden=effects, right=right, first_named=True, all_named=True, wrong=wrong,
        false_laws=(), deviations=(), error_ratio=1.0, seconds=1.0, processor_seconds=1.0, verdict="model",
        added=("a",), told=("b",),
    )  # fmt: skip


def test_effects_have_a_row_where_one_alone_is_hidden() -> None:
    outcomes = [
        hidden("one", "1", "drag"), hidden("one", "2", "drag", right=False), hidden("one", "3", "tow"),
        hidden("two", "4", "drag", "tow", wrong=("x",)), hidden("two", "5", "lag"), hidden("none", "6"),
    ]  # fmt: skip
    found = hidden_summary.summary(("one", "two", "none"), outcomes)
    assert [(row["suite"], row["cases"]) for row in found["suites"]] == [("one", 3), ("two", 2), ("none", 1)]
    assert [(row["suite"], row["effect"], row["cases"], row["right"]["hits"]) for row in found["effects"]] == [
        ("one", "drag", 2, 1), ("one", "tow", 1, 1), ("two", "lag", 1, 1),
    ]  # fmt: skip
    assert [(row["case"], row["added"]) for row in found["missed"]] == [("2", ["a", "b"]), ("4", ["a", "b"])]


@pytest.mark.parametrize("count", [1, 4])
def test_the_page_of_hidden_effects_tells_how_many_cases_there_are(count: int) -> None:
    found = hidden_summary.summary(("one",), [hidden("one", str(n), "drag") for n in range(count)])
    document = {"versions": {"numpy": "2"}, "seeds": [1, 2], "date": "2026-01-02T03", "cases": [{}] * count, **found}
    assert f"{count} cases, seeds 1, 2; finished 2026-01-02; numpy 2." in hidden_page(document)


def test_a_fleet_is_judged_robot_by_robot_and_group_by_group() -> None:
    """Seven robots: three drag and are found; one tows and is not; two of three healthy ones are called ill."""
    truth: dict[str, Any] = {f"d{n}": {"drag": {"c": 1.0}} for n in range(3)}
    truth |= {"t": {"tow": {"m": 2.0}}, **{f"h{n}": {} for n in range(3)}}

    def effect(name: str, *alike: str) -> dict[str, Any]:
        return {"effect": name, "indistinguishable_from": alike}

    def group(kind: str, *robots: str, effects: tuple[Any, ...] = ()) -> dict[str, Any]:
        return {"kind": kind, "robots": list(robots), "effects": list(effects)}

    found = {f"d{n}": 1.0 + 0.5 * n for n in range(3)}
    document = {
        "groups": [
            group("missing", "d0", "d1", "d2", effects=(effect("drag"),)), group("nothing", "t", "h0"),
            group("missing", "h1", effects=(effect("lag"),)), group("unexplained", "h2"),
        ],
        "robots": [
            {"robot": name, "found": [{"effect": "drag", "parameters": {"c": {"value": found[name], "std": 0.25}}}]
             if name in found else []}
            for name in truth
        ],
        "common": {"effects": [{"effect": "a", "confirmed": {"holds": True}},
                               {"effect": "b", "confirmed": {"holds": False}}]},
        "false_discovery": 0.05,
    }  # fmt: skip
    judged = judged_fleet(document, truth)
    assert judged["hidden"] == {"hits": 3, "of": 4, "interval_95": [round(v, 4) for v in wilson_interval(3, 4)]}
    assert judged["healthy"] == {"hits": 1, "of": 3, "interval_95": [round(v, 4) for v in wilson_interval(1, 3)]}
    assert (judged["groups_hidden"], judged["groups_right"], judged["groups_false"]) == (2, 1, 2)
    assert (judged["within_two_deviations"]["hits"], judged["within_two_deviations"]["of"]) == (2, 3)
    assert (judged["largest_deviation"], judged["common_named"]) == (4.0, ["a"])
    assert [row["robot"] for row in judged["wrong"]] == ["t", "h1", "h2"]


def test_what_is_hidden_in_all_robots_has_to_be_named_as_common_and_counts_in_none() -> None:
    """All stand in the wind; one drags, whose coefficient is found three deviations too small."""
    truth: dict[str, Any] = {"d": {"wind": {"v": 3.0}, "drag": {"c": 1.0}}, "h": {"wind": {"v": 3.0}}}
    drag = {"effect": "drag", "parameters": {"c": {"value": 0.25, "std": 0.25}}}
    wind = {"effect": "wind", "parameters": {"v": {"value": 9.0, "std": 0.25}}}
    document = {
        "groups": [
            {"kind": "missing", "robots": ["d"], "effects": [{"effect": "drag", "indistinguishable_from": []}]},
            {"kind": "nothing", "robots": ["h"], "effects": []},
        ],
        "robots": [{"robot": "d", "found": [wind, drag]}, {"robot": "h", "found": [wind]}],
        "common": None, "false_discovery": 0.05,
    }  # fmt: skip
    judged = judged_fleet(document, truth)
    assert (judged["hidden"]["hits"], judged["hidden"]["of"]) == (1, 1)
    assert (judged["healthy"]["hits"], judged["healthy"]["of"]) == (1, 1)
    assert (judged["within_two_deviations"]["hits"], judged["within_two_deviations"]["of"]) == (0, 1)
    assert judged["largest_deviation"] == 3.0
    assert (judged["groups_hidden"], judged["groups_right"], judged["groups_false"]) == (1, 1, 0)
    assert (judged["common_hidden"], judged["common_named"], judged["wrong"]) == (["wind"], [], [])
    alone = judged_fleet(document, truth | {"d": truth["h"]})
    assert (alone["hidden"], alone["groups_hidden"], alone["groups_false"]) == (None, 0, 1)


def test_costs_of_a_fleet_are_medians_and_the_largest_of_each() -> None:
    robots = [
        {"kind": kind, "processor_seconds": seconds, "memory_mebibytes": memory}
        for kind, seconds, memory in (("nothing", 1.0, 300), ("nothing", 2.0, 500), ("nothing", 9.0, 400),
                                      ("unexplained", 4.0, 100))
    ]  # fmt: skip
    told = fleet_diagnosis._costs({"robots": robots, "diagnosed_now": 3}, 12.34)
    assert told["processor_seconds_a_robot"] == {"median": 3.0, "largest": 9.0, "nothing": 2.0, "unexplained": 4.0}
    assert (told["memory_mebibytes_of_a_worker"], told["diagnosed_now"], told["wall_seconds"]) == (500, 3, 12.3)


def test_cases_that_are_not_wholly_right_are_told() -> None:
    """Wrong, with a wrong addition, or with a law that is none; and of deviations -2.5, 0.5 and 1 two are within 2."""
    usual: dict[str, Any] = {
        "suite": "one", "hidden": ("drag",), "added": ("drag",), "told": (), "verdict": "model", "right": True,
        "first_named": True, "all_named": True, "wrong": (), "false_laws": (), "deviations": (), "error_ratio": 1.0,
        "seconds": 1.0, "processor_seconds": 1.0,
    }  # fmt: skip
    cases: Any = [
        SimpleNamespace(**usual | {"case": name} | more)
        for name, more in (
            ("a", {"deviations": (-2.5, 0.5, 1.0)}), ("b", {"right": False}), ("c", {"wrong": ("tow",)}),
            ("d", {"false_laws": ("x",)}),
        )
    ]  # fmt: skip
    told = hidden_summary.summary(["one"], cases)
    assert [case["case"] for case in told["missed"]] == ["b", "c", "d"]
    within = told["suites"][0]["parameters_within_two"]
    assert (within["hits"], within["of"]) == (2, 3)
