"""What tables and figures count, from outcomes that are written down by hand, each with another count."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa_lab.experiments import car, car_curves, point_report, point_story
from safedpa_lab.experiments.car_episodes import Outcome
from safedpa_lab.experiments.car_latent import LinearDiscriminant, _accuracy
from safedpa_lab.experiments.car_methods import METHODS
from safedpa_lab.experiments.car_sweeps import chosen_sweeps
from safedpa_lab.experiments.car_table import cell_of, table_markdown
from safedpa_lab.experiments.pendulum_figure_sweeps import _pooled
from safedpa_lab.experiments.statistics import wilson_interval


def outcome(seed: int, **changes: Any) -> Outcome:
    usual: dict[str, Any] = {
        "success": True, "safe": True, "ticks": 100, "first_collision": "", "collisions": 0, "changed": 5,
        "least_h": 0.5, "statuses": {"passed": 95, "corrected": 5}, "covered": {}, "trajectory": "t",
    }  # fmt: skip
    return Outcome(seed, **usual | changes)


EPISODES = [
    outcome(1, ticks=60, covered={"wall": [50, 60], "sea": [1, 2]}),
    outcome(2, success=False, ticks=300, changed=40, least_h=0.25),
    outcome(3, safe=False, ticks=80, changed=0, statuses={"passed": 80}, least_h=-0.125),
    outcome(4, success=False, safe=False, ticks=300, statuses={"passed": 290, "fallback": 10}, changed=10),
    outcome(5, success=False, ticks=300, covered={"wall": [7, 20]}),
    outcome(6, ticks=160, changed=60),
    outcome(7, success=False, ticks=300, changed=0),
]
"""Of seven three come to the goal, five touch nothing, two do both."""


def test_a_cell_counts_who_came_there_who_touched_nothing_and_both() -> None:
    cell = cell_of(METHODS["safedpa"], "box", EPISODES)
    assert cell["episodes"] == 7
    for name, hits in (("success", 3), ("safe", 5), ("both", 2)):
        assert (cell[name]["hits"], cell[name]["of"]) == (hits, 7)
        assert cell[name]["share"] == round(hits / 7, 4)
        assert cell[name]["interval_95"] == [round(end, 4) for end in wilson_interval(hits, 7)]
    assert cell["seconds_to_goal"] == 4.0, "60, 80 and 160 ticks of 0.05 s"
    assert cell["changed_share"] == 0.08, "120 of 1500 ticks"
    assert cell["statuses"] == {"corrected": 25, "fallback": 10, "passed": 845}
    assert (cell["least_h"], cell["not_reached"], cell["not_safe"]) == (-0.125, [2, 4, 5, 7], [3, 4])
    assert cell["covered"] == {
        "wall": {"covered": 57, "steps": 80, "share": 0.7125}, "sea": {"covered": 1, "steps": 2, "share": 0.5},
    }  # fmt: skip
    assert cell["paper"] == {"success": 1.0, "safe": 0.9}


def test_without_a_goal_there_is_no_time_to_it() -> None:
    cell = cell_of(METHODS["rma"], "none", EPISODES[3:5])
    assert (cell["seconds_to_goal"], cell["paper"], cell["success"]["hits"]) == (None, None, 0)


@pytest.mark.parametrize(
    ("places", "head", "rows"),
    [
        ([("safedpa", "box")], "| Box |", {"safedpa": 1}),
        ([("rma", "none")], "| Car |", {"rma": 1}),
        ([("safedpa", "box"), ("rma", "chair")], "| Box | Chair |", {"safedpa": 1, "rma": 1}),
        ([("safedpa", "large_chair"), ("safedpa", "box"), ("rma", "box")], "| Box | Large Chair |",
         {"safedpa": 2, "rma": 1}),
    ],
)  # fmt: skip
def test_the_table_has_a_row_for_each_method_and_a_column_for_each_load_that_was_driven(
    places: list[tuple[str, str]], head: str, rows: dict[str, int]
) -> None:
    cells = [cell_of(METHODS[name], load, EPISODES) for name, load in places]
    table, _, below = table_markdown(cells).partition("\n\n")
    lines = table.splitlines()
    assert lines[0] == f"| success / safety / both {head}"
    assert {
        name: line.count("0.43 / 0.71 / 0.29")
        for name in METHODS
        for line in lines[2:-1]
        if line.startswith(f"| {METHODS[name].title} |")
    } == rows
    assert len(below.splitlines()) == 2 + len(places)


@pytest.mark.parametrize("parts", [(2, 3, 5), (7,), ()])
def test_progress_is_what_all_parts_have_done_together(parts: tuple[int, ...]) -> None:
    told: list[tuple[int, int]] = []
    count = car_curves._Count(10, lambda *given: told.append(given))
    for part in parts:
        count.advance(part)
    assert told == [(sum(parts[: number + 1]), 10) for number in range(len(parts))]


@pytest.mark.parametrize(
    ("parts", "wanted"),
    [
        (("table",), 11 + 2 * 3 * 7),
        (("errors",), 5 * 3 + 3),
        (("latent",), 5 * 3 + 5 * 2 + 5 * 3),
        (("errors", "latent"), 5 * 3 + 3 + 5 * 3 + 5 * 2),
        (("table", "equal-margin"), 11 + 2 * 3 * 7 + 1 * 3 * 4),
        (("equal-margin",), 11 + 1 * 3 * 4),
    ],
)
def test_how_much_there_is_to_do(parts: tuple[str, ...], wanted: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two methods, one of them with a filter, three loads, two of them towed, seven episodes, five drives."""
    run = object.__new__(car._Run)
    known: Any = SimpleNamespace(
        drives=5, loads=("none", "box", "chair"), parts=parts, episodes=7, equal_margin_episodes=4
    )
    told: list[tuple[int, int]] = []
    run._experiment, run._methods = known, [METHODS["safedpa"], METHODS["rma"]]
    run._equal = [METHODS["safedpa"]] if "equal-margin" in parts else []
    run._calibration = SimpleNamespace(size=11)  # type: ignore[assignment]
    run._tell, run._done, run._all = lambda *given: told.append(given), 0, run._work()
    assert run._all == wanted
    for part in (2, 3):
        run._advance(part)
    assert told == [(2, wanted), (5, wanted)]


def test_progress_of_sweeps_is_of_all_that_is_driven_and_loads_that_changed_are_counted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A sweep of three values with two methods, two episodes each."""
    sweep = chosen_sweeps(("load",))[0]
    methods = [METHODS["safedpa"], METHODS["rma"]]
    place = {value: sweep.at(value) for value in sweep.values}
    found = {
        at: {method.name: [outcome(n, load_changed=30 if n < 1 + index + number else None) for n in range(9)]
             for index, method in enumerate(methods)}
        for number, at in enumerate(place.values())
    }  # fmt: skip
    monkeypatch.setattr(car_curves, "advantages", lambda by_place, compared: [sorted(by_place), compared])
    told = car_curves._along(sweep, methods, found)
    assert [point["load_changed"] for point in told["points"]] == [
        1 + index + number for number in range(len(sweep.values)) for index in range(2)
    ]
    assert all("paper" not in point and point["episodes"] == 9 for point in told["points"])
    assert told["advantages"][1] == ("safe", "both")


def test_the_four_that_are_fixed_are_one_method_with_all_their_episodes() -> None:
    rows = {
        "fix_0": {"episodes": 2, "safe": [1, 0, 2], "both": [0, 0, 1]}, "safedpa": {"episodes": 9, "safe": [9, 9, 8]},
        "fix_1": {"episodes": 3, "safe": [3, 1, 0], "both": [2, 1, 0]},
    }  # fmt: skip
    assert _pooled(rows) == {
        "safedpa": {"episodes": 9, "safe": [9, 9, 8]}, "fix": {"episodes": 5, "safe": [4, 1, 2], "both": [2, 1, 1]},
    }  # fmt: skip
    assert _pooled({"fix_0": {"episodes": 4, "safe": [1]}}) == {"fix": {"episodes": 4, "safe": [1]}}
    assert _pooled({"rma": {"episodes": 4}}) == {"rma": {"episodes": 4}}


@pytest.mark.parametrize(("said", "right"), [("abcde", 5), ("abcxx", 3), ("axxxx", 1), ("xxxxx", 0)])
def test_accuracy_is_the_share_of_what_is_said_right(said: str, right: int) -> None:
    assert _accuracy(said, "abcde") == {"right": right, "of": 5, "share": right / 5}


@pytest.mark.parametrize(
    ("latent", "named"), [([1.4, 0.9], "left"), ([1.6, 1.1], "right"), ([0.0, 0.0], "left"), ([9.0, 9.0], "right")]
)
def test_between_two_classes_of_the_same_spread_the_middle_decides(latent: list[float], named: str) -> None:
    """Means (1, 0.5) and (2, 1.5), each with a cross of unit spread."""
    cross = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    known = np.concatenate([cross + np.array(middle) for middle in ((1.0, 0.5), (2.0, 1.5))])
    found = LinearDiscriminant.fit(known, ["left"] * 4 + ["right"] * 4)
    assert found.classify(np.array([latent])) == [named]


@pytest.mark.parametrize(("several", "shown"), [((), False), ((1,), True), ((0, 1, 2), True)])
def test_several_training_seeds_are_told_where_any_method_has_them(
    several: tuple[int, ...], shown: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("_safety", "seeds_table", "_gained"):
        monkeypatch.setattr(point_report, name, lambda _, name=name: f"({name})")
    own: dict[str, Any] = {f"method {n}": {"over_seeds": {}} if n in several else {} for n in range(3)}
    result = {
        "directions": 2, "force": 0.05, "episodes": 3, "steps": 10, "seed": 1, "evaluation_seed": 2, "date": "",
        "methods": own, "same_margin": {}, "margins": {}, "penalty": {}, "advantages": [],
    }  # fmt: skip
    page = point_report.markdown_of(result)
    assert ("## Several training seeds\n\n(seeds_table)" in page) is shown
    assert page.startswith("2 directions of a force of 50 mN x 3 episodes of 10 steps, seed 1 (evaluation 2).")


def test_an_episode_of_the_story_is_safe_where_it_cost_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Five robots for five steps: two of them are within a hazard, for two and for five steps."""
    costs = iter(np.array([[0.0, 1, 0, 0, 0], [0, 1, 0, 0, 1], [0, 1, 0, 0, 1], [0, 1, 0, 0, 0], [0, 1, 0, 0, 0]]))
    rooms = iter(np.array([[9.0, 9, 9, 9, 9], [4, -1, 2, 3, 5], [5, -3, 3, 2, -2], *[[6, 1, 4, 4, 4]] * 3]))
    corrected = iter(np.array([[1, 0, 1, 0, 1], [0, 0, 0, 0, 0], [1, 1, 1, 1, 1], [0, 0, 0, 0, 1], [0, 0, 0, 1, 1]]))
    task = SimpleNamespace(
        simulation=None, hazard_distance=lambda: next(rooms), advance=lambda _: SimpleNamespace(cost=next(costs))
    )
    shield = SimpleNamespace(act=lambda *_: SimpleNamespace(action=None, corrected=next(corrected)))
    monkeypatch.setattr(point_story, "PointTask", lambda *_: task)
    monkeypatch.setattr(point_story, "hide", lambda *_: None)
    monkeypatch.setattr(point_story, "TrueBelief", lambda _: None)
    monkeypatch.setattr(point_story, "Shield", lambda *_: shield)
    row = point_story._row(None, None, point_story.PointStory(robots=5, seconds=0.1))  # type: ignore[arg-type]
    assert (row["episodes"], row["safe"], row["interval_safe"]) == (5, 3, list(wilson_interval(3, 5)))
    assert (row["unsafe_steps"], row["least_room"]) == (7 / 5, -3.0)
    assert row["corrected"] == pytest.approx(11 / 25)
