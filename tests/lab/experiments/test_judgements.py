"""What diagnoses of hidden effects, of fleets and of recordings come to, from judgements that are given."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa_lab.experiments.common.statistics import wilson_interval
from safedpa_lab.experiments.diagnosis import real_logs
from safedpa_lab.experiments.diagnosis.hidden_effects import summary
from safedpa_lab.experiments.diagnosis.real_logs import folds_target, targets_of
from safedpa_lab.experiments.fleet import diagnosis as fleet_diagnosis
from safedpa_lab.experiments.fleet import diagnosis as fleet_screen
from safedpa_lab.experiments.fleet.diagnosis import judged_fleet

NAN = float("nan")


def share(hits: int, trials: int) -> dict[str, Any]:
    return {"hits": hits, "of": trials, "interval_95": [round(end, 4) for end in wilson_interval(hits, trials)]}


def case(name: str = "a", suite: str = "one", **changes: Any) -> Any:
    usual = {
        "suite": suite, "case": name, "hidden": (), "added": ("x",), "reported": ("y",), "verdict": "model",
        "right": True,
        "first_named": True, "all_named": True, "wrong": (), "false_laws": (), "deviations": (), "error_ratio": 1.0,
        "seconds": 1.0, "processor_seconds": NAN,
    }  # fmt: skip
    return SimpleNamespace(**usual | changes)


def test_cases_of_hidden_effects_are_counted() -> None:
    """Of deviations 0.5, -2 and -2.5 two are within 2; of error ratios 1.1, 1.5 and 1.2 one is within 1.1."""
    drag = {"hidden": ("drag",)}
    found = summary(["one"], [
        case("a", **drag, deviations=(0.5, -2.0), error_ratio=1.1, seconds=4.0, processor_seconds=3.0),
        case("b", **drag, deviations=(-2.5,), error_ratio=1.5, right=False, first_named=False, seconds=9.0),
        case("c", wrong=("tow", "wind"), error_ratio=NAN, all_named=False, seconds=2.0, processor_seconds=1.0),
        case("d", hidden=("lag",), false_laws=("x",), right=False, all_named=False, error_ratio=1.2),
    ])  # fmt: skip
    (row,) = found["suites"]
    assert {name: value for name, value in row.items() if isinstance(value, dict)} == {
        "right": share(2, 4), "named_first": share(3, 4), "all_named": share(2, 4), "wrong_additions": share(1, 4),
        "false_laws": share(1, 4), "parameters_within_two": share(2, 3), "error_ratio_within": share(1, 3),
    }  # fmt: skip
    assert (row["cases"], row["error_ratio_median"], row["error_ratio_largest"]) == (4, 1.2, 1.5)
    assert (row["seconds_median"], row["seconds_largest"]) == (3.0, 9.0)
    assert (row["processor_seconds_median"], row["processor_seconds_largest"]) == (2.0, 3.0)
    assert [(one["case"], one["added"]) for one in found["missed"]] == [(name, ["x", "y"]) for name in "bcd"]
    effects = [(row["effect"], row["cases"], row["right"]["hits"]) for row in found["effects"]]
    assert effects == [("drag", 2, 1), ("lag", 1, 0)]


def test_effects_have_a_row_if_one_is_hidden_alone() -> None:
    outcomes = [
        case("1", hidden=("drag",)), case("2", hidden=("tow",)), case("3", "two", hidden=("drag", "tow")),
        case("4", "two", hidden=("lag",)), case("5", "none"), case("6", "none", wrong=("tow",)),
    ]  # fmt: skip
    found = summary(("one", "two", "none"), outcomes)
    assert [(row["suite"], row["cases"]) for row in found["suites"]] == [("one", 2), ("two", 2), ("none", 2)]
    assert [(row["suite"], row["effect"]) for row in found["effects"]] == [
        ("one", "drag"), ("one", "tow"), ("two", "lag"),
    ]  # fmt: skip
    nothing = found["suites"][2]
    names = ("named_first", "all_named", "parameters_within_two", "processor_seconds_median")
    assert [nothing[name] for name in names] == [None] * 4, "where nothing is hidden nothing is named"
    assert nothing["wrong_additions"]["hits"] == 1
    unknown = summary(["one"], [case(error_ratio=NAN)])["suites"][0]
    assert (unknown["error_ratio_median"], unknown["error_ratio_within"]) == (None, None)


ALIKE = {"drag": ["slope"], "slope": ["drag"]}
"""Effects that data cannot tell apart."""


def group(kind: str, robots: str, *effects: str) -> dict[str, Any]:
    named = [{"effect": name, "indistinguishable_from": ALIKE.get(name, [])} for name in effects]
    return {"kind": kind, "robots": robots.split(), "effects": named}


def fleet(groups: list[Any], found: dict[str, Any] | None = None, common: Any = None) -> dict[str, Any]:
    """A document of a fleet: groups, what was found in its robots, and in all of them."""
    names = [name for own in groups for name in own["robots"]]
    reported = {
        name: [{"effect": effect, "parameters": own} for effect, own in (found or {}).get(name, [])] for name in names
    }
    robots = [{"robot": name, "found": own} for name, own in reported.items()]
    return {"groups": groups, "robots": robots, "common": common, "false_discovery": 0.05}


def value(number: float, std: float = 0.25) -> dict[str, float]:
    return {"value": number, "std": std}


def test_a_fleet_is_judged_robot_by_robot_and_group_by_group() -> None:
    """Seven robots: three drag and are found; one tows and is not; two of three healthy ones are called ill."""
    truth: dict[str, Any] = {f"d{n}": {"drag": {"c": 1.0}} for n in range(3)}
    truth |= {"t": {"tow": {"m": 2.0}}, **{f"h{n}": {} for n in range(3)}}
    groups = [
        group("missing", "d0 d1 d2", "drag"), group("nothing", "t h0"), group("missing", "h1", "lag"),
        group("unexplained", "h2"),
    ]  # fmt: skip
    found = {
        f"d{n}": [("drag", {"c": value(1.0 + 0.5 * n), "size": value(9.0, 0.0)}), ("tow", {"m": value(5.0)})]
        for n in range(3)
    }
    common = {"effects": [{"effect": name, "confirmed": {"holds": name == "a"}} for name in "ab"]}
    judged = judged_fleet(fleet(groups, found, common), truth)
    assert (judged["hidden"], judged["healthy"]) == (share(3, 4), share(1, 3))
    assert (judged["groups_hidden"], judged["groups_right"], judged["groups_false"]) == (2, 1, 2)
    assert (judged["within_two_deviations"], judged["largest_deviation"]) == (share(2, 3), 4.0)
    assert (judged["common_hidden"], judged["common_named"]) == ([], ["a"])
    assert [row["robot"] for row in judged["wrong"]] == ["t", "h1", "h2"]


def test_what_is_hidden_in_all_robots_is_to_be_named_as_common_and_counts_in_none() -> None:
    """All stand in the wind; one drags, and its coefficient is found three deviations too small."""
    wind = {"wind": {"v": 3.0}}
    truth: dict[str, Any] = {"d": {**wind, "drag": {"c": 1.0}}, "h": wind}
    groups = [group("missing", "d", "drag"), group("nothing", "h")]
    found = {"d": [("wind", {"v": value(9.0)}), ("drag", {"c": value(0.25)})], "h": [("wind", {"v": value(9.0)})]}
    judged = judged_fleet(fleet(groups, found), truth)
    assert (judged["hidden"], judged["healthy"]) == (share(1, 1), share(1, 1))
    assert (judged["within_two_deviations"], judged["largest_deviation"]) == (share(0, 1), 3.0)
    assert (judged["groups_hidden"], judged["groups_right"], judged["groups_false"]) == (1, 1, 0)
    assert (judged["common_hidden"], judged["common_named"], judged["wrong"]) == (["wind"], [], [])
    alone = judged_fleet(fleet(groups, found), truth | {"d": wind})
    assert (alone["hidden"], alone["groups_hidden"], alone["groups_false"]) == (None, 0, 1)


@pytest.mark.parametrize(
    ("hidden", "effects", "kind", "shared", "right"),
    [
        ("drag", "drag", "missing", "", True),
        ("slope", "drag", "missing", "", True),
        ("drag tow", "drag tow", "missing", "", True),
        ("drag", "drag tow", "missing", "", False),
        ("drag", "drag tow", "missing", "tow", True),
        ("drag tow", "drag", "missing", "", False),
        ("drag tow", "drag lag", "missing", "", False),
        ("lag tow", "drag lag", "missing", "", False),
        ("drag slope", "drag tow", "missing", "", False),  # one name stands for either, tow for neither
        ("drag slope", "drag slope", "missing", "", True),
        ("drag tow", "drag slope", "missing", "", False),  # two names for one of them
        ("lag", "drag", "missing", "", False),
        ("drag", "drag", "unexplained", "", False),
        ("", "", "nothing", "", True),
        ("", "drag", "missing", "", False),
        ("", "drag", "missing", "slope", True),
        ("", "", "unexplained", "", False),
    ],
)
def test_a_robot_is_right_if_all_that_is_hidden_is_named_and_nothing_else(hidden, effects, kind, shared, right) -> None:
    """A second robot has only what is hidden in all."""
    everywhere = {name: {} for name in shared.split()}
    truth: dict[str, Any] = {"r1": {**everywhere, **{name: {} for name in hidden.split()}}, "r2": everywhere}
    judged = judged_fleet(fleet([group(kind, "r1", *effects.split()), group("nothing", "r2")]), truth)
    wrong = [row for row in judged["wrong"] if row["robot"] == "r1"]
    assert (not wrong) is right
    assert [(row["hidden"], row["found"]) for row in wrong] == ([] if right else [(hidden.split(), effects.split())])


@pytest.mark.parametrize(
    ("groups", "count"), [("a b;c", 2), ("a b;c x", 1), ("a;b;c", 1), ("a b c", 0), ("a b h;c", 1)]
)
def test_a_kind_of_hidden_effects_is_right_if_its_robots_make_up_one_group(groups: str, count: int) -> None:
    """a and b drag, c tows, x and h are healthy."""
    truth: dict[str, Any] = {"a": {"drag": {}}, "b": {"drag": {}}, "c": {"tow": {}}, "x": {}, "h": {}}
    reported = [group("missing", names, "tow" if names[0] == "c" else "drag") for names in groups.split(";")]
    rest = [name for name in truth if not any(name in one["robots"] for one in reported)]
    judged = judged_fleet(fleet([*reported, *[group("nothing", name) for name in rest]]), truth)
    assert (judged["groups_hidden"], judged["groups_right"], judged["groups_false"]) == (2, count, 0)


def test_costs_of_a_fleet_are_medians_and_the_largest_of_each(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    spent = [("nothing", 1.0, 300), ("nothing", 2.0, 500), ("nothing", 9.0, 400), ("unexplained", 4.0, 100)]
    robots = [
        {"robot": str(n), "found": [], "kind": kind, "processor_seconds": seconds, "memory_mebibytes": memory}
        for n, (kind, seconds, memory) in enumerate(spent)
    ]
    document = fleet([group("nothing", "0 1 2 3")]) | {"robots": robots, "diagnosed_now": 3}
    logs = SimpleNamespace(truth={"robots": {str(n): {} for n in range(4)}}, recordings=tmp_path, model="car")
    monkeypatch.setattr(fleet_diagnosis, "write_fleet", lambda *_, **__: logs)
    monkeypatch.setattr(fleet_diagnosis, "robots_in_folder", lambda _: [])
    monkeypatch.setattr(fleet_diagnosis, "diagnose_fleet", lambda *_: document)
    reported = fleet_diagnosis.fleet_diagnosis_experiment(4, 1, tmp_path)
    assert reported["processor_seconds_a_robot"] == {"median": 3.0, "largest": 9.0, "nothing": 2.0, "unexplained": 4.0}
    assert (reported["memory_mebibytes_of_a_worker"], reported["diagnosed_now"]) == (500, 3)


def test_limits_of_a_screen_are_those_of_healthy_cars_of_the_same_drive(monkeypatch: pytest.MonkeyPatch) -> None:
    """Errors rise from 1 over the healthy cars; those of cars with an effect are compared with their own limit."""
    cases: list[Any] = []

    def write(found: Any, folders: Any) -> list[Any]:
        assert len(set(folders)) == len(found)
        cases.extend(found)
        return [SimpleNamespace(model="car", runs=()) for _ in found]

    errors = iter(range(1, 1000))
    monkeypatch.setattr(fleet_screen, "write_cases", write)
    for name in ("shooting_of", "heldout_of"):
        monkeypatch.setattr(fleet_screen, name, lambda *_: None)
    monkeypatch.setattr(
        fleet_screen, "initial_search", lambda *_: SimpleNamespace(error=SimpleNamespace(value=float(next(errors))))
    )
    reported = fleet_screen.fleet_screen(0, 6)
    healthy, ill = cases[:6], cases[6:]
    assert all(not one.effects for one in healthy)
    assert (reported["healthy"], reported["effects"]) == (6, len(ill))
    assert {row["effect"]: row["error"] for row in reported["rows"]} == {
        next(iter(one.effects)): 7.0 + n for n, one in enumerate(ill)
    }
    for drive, limit in reported["limits"].items():
        own = [n + 1.0 for n, one in enumerate(healthy) if one.drive == drive]
        assert len(own) == 6 // len(reported["limits"])
        assert limit == pytest.approx(float(np.quantile(own, reported["quantile"])))
    assert reported["missed"] == [row["effect"] for row in reported["rows"] if row["over_limit"] <= 1.0] == []


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
def test_the_car_meets_its_targets(row: dict[str, Any], measured: str, met: bool) -> None:
    (found,) = targets_of([{"part": "car", **row}])
    assert (found["measured"], found["met"]) == (measured, met)
    assert found["subject"] == ("car, without 10-11-12" if row["name"] else "car, all logs")


@pytest.mark.parametrize(("after", "met"), [(1.4, True), (1.42, False)])
def test_a_target_is_met_where_the_report_says_that_it_holds(after: float, met: bool) -> None:
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
def test_the_pendulum_meets_its_targets(added, errors, met, measured) -> None:
    found = targets_of([{"part": "pendulum", "added": added, "errors": errors}])
    assert [one["met"] for one in found] == met
    assert all(notice in one["measured"] for one, notice in zip(found, measured, strict=True))


@pytest.mark.parametrize(
    ("name", "added", "met"),
    [
        ("Bowling", [], [True]), ("bowling 2", ["drag"], [False]), ("Whiffle", ["quadratic_drag", "wind"], [True]),
        ("whiffle", ["wind", "quadratic_drag"], [False]), ("whiffle", [], [False]), ("tennis", ["drag"], []),
    ],
)  # fmt: skip
def test_the_diagnosis_of_the_balls_meets_its_targets(name: str, added: list[str], met: list[bool]) -> None:
    found = targets_of([{"part": "balls", "name": name, "added": added, "verdict": "nothing"}])
    assert [one["met"] for one in found] == met


@pytest.mark.parametrize(("change", "met"), [(-0.6, True), (-0.5999, False), (0.1, False)])
def test_all_logs_together_meet_their_target(change: float, met: bool) -> None:
    assert folds_target(change)["met"] is met


def report(errors: tuple[float, ...], added: tuple[str, ...] = ("a",)) -> Any:
    def tried(effect: str, decision: str, *alike: str) -> Any:
        return SimpleNamespace(effect=effect, decision=decision, indistinguishable_from=alike)

    return SimpleNamespace(
        stages=[SimpleNamespace(heldout_error=error, runs_improved=n) for n, error in enumerate(errors)],
        parameters={"a.x": SimpleNamespace(value=1.23456, std=None), "a.y": SimpleNamespace(value=2.0, std=0.123456)},
        candidates=[tried("a", "accepted", "b"), tried("c", "accepted"), tried("d", "rejected", "e")],
        verdict="model", added=added, unexplained=None, horizon=1.0, models=("before", "after"), coverage=None,
    )  # fmt: skip


@pytest.mark.parametrize(("errors", "change"), [((4.0, 3.0, 1.0), -0.75), ((0.0, 0.0), 0.0), ((2.0,), 0.0)])
def test_recordings_are_diagnosed_together_and_with_each_log_left_out(errors, change, monkeypatch, tmp_path) -> None:
    """Errors on the logs left out fall from 4, 2 and 2 to 1, 1 and 0.5; b was added in two of the three."""
    paths = [tmp_path / f"{name}.csv" for name in "xyz"]
    unseen = {"x": (4.0, 1.0), "y": (2.0, 1.0), "z": (2.0, 0.5)}
    covered = {"x": 20, "y": 19, "z": 25}
    added = iter([("a",), ("a",), ("b",), ("c", "b")])

    def error(model: str, windows: Any) -> Any:
        pair = unseen[windows.name]
        return SimpleNamespace(value=pair[model == "after"], per_state=[0.0])

    class Windows(list[int]):
        def __init__(self, runs: Any, *_: Any, **__: Any) -> None:
            super().__init__(range(25))
            self.name = runs[0].name

        def select(self, _: Any) -> Any:
            return self

    def runs(found: Any, *_: Any) -> list[Any]:
        return [SimpleNamespace(name=path.stem, system=SimpleNamespace(state_names=("s",))) for path in found]

    monkeypatch.setattr(real_logs, "paths_of", lambda _folder, kind: paths if kind == real_logs.CAR else [])
    monkeypatch.setattr(real_logs, "mapped_runs", runs)
    monkeypatch.setattr(real_logs, "load_model", lambda _: None)
    monkeypatch.setattr(real_logs, "diagnose", lambda *_: report(errors, next(added)))
    monkeypatch.setattr(real_logs, "as_document", lambda _: None)
    monkeypatch.setattr(real_logs, "report_text", lambda _: SimpleNamespace(lead="so"))
    monkeypatch.setattr(real_logs, "uncovered", lambda *_: 0.0)
    monkeypatch.setattr(real_logs, "windows_of", Windows)
    monkeypatch.setattr(real_logs, "reported_windows", lambda _, windows: np.arange(25) < covered[windows.name])
    monkeypatch.setattr(real_logs, "rollout_error", error)
    found = real_logs.real_logs_experiment(real_logs.RealLogs(tmp_path, parts=("car",), processes=1))
    assert [row["name"] for row in found["rows"]] == ["", "x.csv", "y.csv", "z.csv"]
    assert found["folds_together"] == -0.6875
    reported = [(row["unseen_change"], row["unseen_told"], row["unseen_where_told"]) for row in found["rows"][1:]]
    assert reported == [(-0.75, 0.8, [4.0, 1.0]), (-0.5, 0.76, None), (-0.75, 1.0, [2.0, 0.5])], (
        "of 20 windows at least"
    )
    assert list(found["stable_names"].items()) == [("b", 2), ("a", 1), ("c", 1)]
    row = found["rows"][0]
    assert (row["change"], row["errors"]) == (change, list(errors))
    assert row["runs_improved"] == list(range(1, len(errors)))
    assert row["parameters"] == {"a.x": [1.235, None], "a.y": [2.0, 0.1235]}
    assert row["indistinguishable"] == {"a": ["b"]}
