"""What experiments of the point robot count of episodes and of learning, compared with episodes written by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from safedpa_lab.experiments import point_episodes, point_learning, point_relinearised
from safedpa_lab.experiments.point_episodes import Work, account_of, best_penalty, over_seeds
from safedpa_lab.experiments.point_learning import PointLearning
from safedpa_lab.experiments.point_learning_report import driven_table
from safedpa_lab.experiments.seeds import SEEDS
from safedpa_lab.experiments.statistics import wilson_interval
from safedpa_lab.point.driven import Driven
from safedpa_lab.point.online_learning import Learning
from safedpa_lab.point.relinearised_drives import FilteredDriver

INF = float("inf")


def driven(first_goal: tuple[float, ...] = (INF, 2.0, 4.0, INF, INF, 3.0)) -> Driven:
    """Two directions, three episodes each, of 50 steps. Safe are 0, 2, 3 and 5; at a goal come 0, 1, 3 and 5."""
    return Driven(
        goals=np.array([1.0, 2.0, 0.0, 3.0, 0.0, 1.0]), reward=np.arange(6.0),
        cost=np.array([0.0, 5.0, 0.0, 0.0, 20.0, 0.0]), least_room=np.array([0.4, -0.1, 0.2, 0.3, 0.5, -0.3]),
        first_goal=np.array(first_goal), corrected=0.25, relaxed=0.125, processor_seconds=0.6, shown=[],
    )  # fmt: skip


def account(monkeypatch: pytest.MonkeyPatch, found: Driven) -> dict[str, Any]:
    monkeypatch.setattr(point_episodes, "driven", lambda *_: found)
    told = account_of(Work("oracle", "", "", "", None, 0.002, 2, 3, 50, 0.008, 1))
    assert (told["method"], told["epsilon"], told["steps"]) == ("oracle", 0.002, 50)
    row: dict[str, Any] = told["account"]
    return row


def test_each_number_of_six_episodes_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    row = account(monkeypatch, driven())
    counts = {"episodes": 6, "safe": 4, "success": 4, "both": 3, "safe_episodes": 4, "reached": 4, "unsafe_steps": 25}
    shares = {"corrected": 0.25, "relaxed": 0.125, "least_room": -0.3}
    each = {"safe_each": "101101", "success_each": "110101", "goals_each": [1, 2, 0, 3, 0, 1]}
    seconds = {"milliseconds_per_episode": 100.0, "microseconds_per_decision": 2000.0}
    expected = {**counts, **shares, **each, **seconds}
    assert {name: row[name] for name in expected} == expected
    assert row["directions_safe_steps"] == pytest.approx([1 - 5 / 150, 1 - 20 / 150], abs=1e-5)
    assert row["directions_safe_episodes"] == pytest.approx([2 / 3, 2 / 3], abs=1e-5)
    assert row["directions_goals"] == pytest.approx([1.0, 4 / 3], abs=1e-5)
    assert row["safe_episodes_interval"] == row["reached_interval"] == list(wilson_interval(4, 6))
    assert [row[name][0] for name in ("goals", "reward", "cost")] == pytest.approx([7 / 6, 2.5, 25 / 6])
    # shares of safe steps 1, 0.9, 1, 1, 0.6, 1: squares around 11/12 add up over 5 and 6
    half = 1.96 * np.sqrt((4 * (1 / 12) ** 2 + (1 / 60) ** 2 + (19 / 60) ** 2) / 30.0)
    assert row["safe_steps"] == pytest.approx([11 / 12, 11 / 12 - half, 11 / 12 + half], abs=1e-4)


@pytest.mark.parametrize(("first_goal", "median"), [((1, 2, 4, INF, INF, 3), 3.5), ((1, INF, 4, INF, INF, 3), None)])
def test_the_median_of_the_first_goal_is_never_where_half_never_came(
    first_goal: tuple[float, ...], median: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert account(monkeypatch, driven(first_goal))["first_goal_median"] == median


def test_the_best_penalty_has_the_highest_return_less_cost() -> None:
    def one(reward: float, cost: float, safe: int) -> dict[str, Any]:
        return {"reward": [reward, 0.0, 9.0], "cost": [cost, 0.0, 9.0], "safe_episodes": safe}

    told = best_penalty({"much": one(20.0, 15.0, 1), "best": one(12.0, 5.0, 2), "none": one(6.0, 0.0, 9)})
    assert told["chosen"] == "best"
    assert {name: row["score"] for name, row in told["rows"].items()} == {"much": 5.0, "best": 7.0, "none": 6.0}
    assert told["seed"] in SEEDS["development"]


def test_several_training_seeds_have_students_interval_over_seeds() -> None:
    """Shares of 1/2 and 3/4, goals of 1 and 3: 12.706 deviations of the mean, 0.125 and 1."""
    accounts = {
        5: {"safe_episodes": 10, "episodes": 20, "goals": [1.0, 0.0, 2.0], "cost": [4.0, 0.0, 9.0]},
        7: {"safe_episodes": 30, "episodes": 40, "goals": [3.0, 0.0, 9.0], "cost": [4.0, 0.0, 9.0]},
    }
    told = over_seeds(accounts)
    assert told["training_seeds"] == [5, 7]
    assert told["safe"] == pytest.approx([0.625, 0.625 - 1.58828, 0.625 + 1.58828], abs=1e-4)
    assert told["goals"] == pytest.approx([2.0, 2.0 - 12.7062, 2.0 + 12.7062], abs=1e-3)
    assert told["cost"] == [4.0, 4.0, 4.0]
    assert told["each"] == [[0.5, 1.0, 4.0], [0.75, 3.0, 4.0]]


def learnt(seeds: int, monkeypatch: pytest.MonkeyPatch, **counts: float) -> tuple[dict[str, Any], list[Learning]]:
    """The account of learnings from nothing behind the filter, two rows each, the last after 400, 800, ... steps."""
    asked = []

    def learned(one: Learning) -> dict[str, Any]:
        asked.append(one)
        usual = {"unsafe": 1.0, "goals": 2.0, "reward": 3.0, "corrected": 4.0, "relaxed": 5.0, "episodes": 10.0}
        row = {"steps": 100, **usual, "safe_episodes": 9.0, "episode_goals": 6.0, **counts}
        last = {**row, "steps": 400 * (one.training_seed + 1), "unsafe": 0.0, "relaxed": 0.5}
        return {
            "training_seed": one.training_seed,
            "rows": [row, last] if one.steps else [],
            "judged": {"goals": [2.0 * one.training_seed]},
        }

    monkeypatch.setattr(point_learning, "learned", learned)
    found = point_learning.point_learning(PointLearning(("nothing",), seeds=tuple(range(seeds))))
    row: dict[str, Any] = found["starts"]["nothing"]["filter"]
    return row, asked


@pytest.mark.parametrize(
    ("seeds", "steps", "goals"), [(1, 400, None), (2, 1200, (1.0, 12.7062)), (3, 2400, (2.0, 4.30265 * 2.0 / 3.0**0.5))]
)
def test_all_steps_of_all_training_seeds_are_added_up(
    seeds: int, steps: int, goals: tuple[float, float] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    told, _ = learnt(seeds, monkeypatch)
    assert told["steps"] == steps
    assert (told["unsafe"], told["goals"], told["relaxed"]) == (seeds, 4.0 * seeds, 5.5 * seeds)
    assert (told["episodes"], told["safe_episodes"]) == (20.0 * seeds, 18.0 * seeds)
    assert told["safe_95"] == list(wilson_interval(18 * seeds, 20 * seeds))
    assert list(told["rows"]) == list(told["judged"]) == [str(seed) for seed in range(seeds)]
    if goals is None:
        assert told["goals_at_the_end"] is None
    else:
        mean, half = goals
        assert told["goals_at_the_end"] == pytest.approx([mean, mean - half, mean + half], abs=1e-3)


def test_without_a_whole_episode_there_is_no_share_of_safe_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    assert learnt(1, monkeypatch, episodes=0.0, safe_episodes=0.0)[0]["safe_95"] is None


@pytest.mark.parametrize(("rows", "first", "last"), [(10, 0.5, 8.5), (5, 0, 4), (3, 0, 2), (15, 1, 13)])
def test_a_learning_is_reported_by_its_first_and_its_last_fifth(rows: int, first: float, last: float) -> None:
    """Rows of 1000 steps each; of a second seed twice as many goals."""
    one = [{"steps": 1000 * (n + 1), "goals": float(n), "reward": 0.0, "corrected": 0.0} for n in range(rows)]
    other = [{**row, "goals": 2.0 * row["goals"]} for row in one]
    for by_seed, times in (({"1": one}, 1.0), ({"1": one, "2": other}, 1.5)):
        row = {"rows": by_seed, "steps": 1, "unsafe": 0, "safe_episodes": 0.0, "episodes": 0.0}
        line = driven_table({"starts": {"nothing": {"none": row}}}).splitlines()[-1]
        assert line.split(" | ")[6:8] == [f"{times * first:.1f}", f"{times * last:.1f}"]


@pytest.mark.parametrize("near", [3, 0])
def test_a_row_of_a_relinearised_filter_counts_its_episodes(near: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Three directions with two episodes each, of 50 steps, which take 3 s of computing together."""
    errors, drivers = [np.array([-0.5, 0.25]), np.array([0.1])] if near else [np.zeros(0)], []

    def drive(driver: FilteredDriver, *_: Any) -> Driven:
        drivers.append(driver)
        driver.seconds = 3.0
        return driven()

    monkeypatch.setattr(point_relinearised, "drive", drive)
    monkeypatch.setattr(point_relinearised, "margins_over_drives", lambda *_: (-0.001, None))
    monkeypatch.setattr(FilteredDriver, "seen", lambda _: errors)
    row = point_relinearised.row_of(point_relinearised.Row("clean", "own", "policy", "", 3, 2, 50, 2, 2, 1, 2))
    (driver,) = drivers
    towards = np.arctan2(*driver.task.simulation.force[::-1]) % (2.0 * np.pi)
    assert towards == pytest.approx(np.array([0.0, 0.0, 2.0, 2.0, 4.0, 4.0]) * np.pi / 3.0)
    assert (row["epsilon"], row["near"], row["count"]) == (0.0, near, 6)
    assert (row["safe"], row["unsafe_steps"], row["safe_each"]) == (4, 25, "101101")
    assert row["safe_interval"] == list(wilson_interval(4, 6))
    assert row["microseconds"] == pytest.approx(10_000.0), "3 s over 300 steps"
    assert (row["median_error"], row["least_room"]) == (0.25 if near else None, -0.3)
    assert row["error_99"] == (pytest.approx(0.25, abs=0.01) if near else None)
