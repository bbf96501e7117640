"""What experiments of the point robot count of episodes and of learning, from what is written down by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa_lab.experiments import point_learning, point_relinearised
from safedpa_lab.experiments.point_episodes import _account, best_penalty, over_seeds
from safedpa_lab.experiments.point_learning_report import _ends
from safedpa_lab.experiments.statistics import wilson_interval
from safedpa_lab.point.driven import Driven


def driven(cost: list[float], goals: list[float], first: list[float] | None = None) -> Driven:
    count = len(cost)
    return Driven(
        goals=np.array(goals), reward=np.array(goals) - np.array(cost), cost=np.array(cost),
        least_room=np.linspace(-0.25, 0.5, count), first_goal=np.array(first or [1.0] * count), corrected=0.25,
        relaxed=0.125, processor_seconds=3.0, shown=[],
    )  # fmt: skip


EPISODES = driven([0.0, 5.0, 0.0, 0.0, 20.0, 0.0], [1.0, 2.0, 0.0, 3.0, 0.0, 1.0])
"""Safe are 0, 2, 3 and 5, at a goal come 0, 1, 3 and 5, and both 0, 3 and 5."""


def test_which_episodes_are_safe_reach_a_goal_or_do_both() -> None:
    row = _account(EPISODES, 2, 50)
    assert (row["safe_each"], row["success_each"]) == ("101101", "110101")
    assert (row["safe"], row["success"], row["both"]) == (4, 4, 3)
    assert (row["safe_episodes"], row["reached"], row["unsafe_steps"]) == (4, 4, 25)
    assert row["goals_each"] == [1, 2, 0, 3, 0, 1]
    assert (row["corrected"], row["relaxed"], row["least_room"]) == (0.25, 0.125, -0.25)


def test_a_share_of_safe_steps_has_the_interval_of_its_mean() -> None:
    """Of 50 steps each: shares of 1, 0.9, 1, 1, 0.6, 1; squares around 11/12 add up to 0.1283, over 5 and 6."""
    mean, low, high = _account(EPISODES, 2, 50)["safe_steps"]
    half = 1.96 * np.sqrt((4 * (1 / 12) ** 2 + (1 / 60) ** 2 + (19 / 60) ** 2) / 30.0)
    assert mean == pytest.approx(5.5 / 6.0)
    assert (low, high) == (pytest.approx(mean - half, abs=1e-4), pytest.approx(mean + half, abs=1e-4))


def test_the_median_of_the_first_goal_is_never_where_half_never_came() -> None:
    inf = float("inf")
    usual: Any = ([0.0] * 4, [1.0] * 4)
    assert _account(driven(*usual, [1.0, 2.0, 4.0, inf]), 2, 50)["first_goal_median"] == 3.0
    assert _account(driven(*usual, [1.0, inf, 4.0, inf]), 2, 50)["first_goal_median"] is None


def test_the_best_penalty_is_the_one_with_the_highest_return_less_cost() -> None:
    def account(reward: float, cost: float, safe: int) -> dict[str, Any]:
        return {"reward": [reward, 0.0, 9.0], "cost": [cost, 0.0, 9.0], "safe_episodes": safe}

    told = best_penalty({"much": account(20.0, 15.0, 1), "best": account(12.0, 5.0, 2), "none": account(6.0, 0.0, 9)})
    assert told["chosen"] == "best"
    assert {name: row["score"] for name, row in told["rows"].items()} == {"much": 5.0, "best": 7.0, "none": 6.0}


def test_training_seeds_are_told_with_students_interval() -> None:
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


def learning_row(steps: int, **counts: float) -> dict[str, float]:
    usual = {"unsafe": 1.0, "goals": 2.0, "reward": 3.0, "corrected": 4.0, "relaxed": 5.0, "episodes": 10.0}
    return {"steps": steps, **usual, "safe_episodes": 9.0, "episode_goals": 6.0, **counts}


@pytest.mark.parametrize("seeds", [1, 2, 3])
def test_all_steps_of_all_training_seeds_are_added_up(seeds: int) -> None:
    """Of each seed two rows, the last after 400 steps more than the seed before."""
    done = [
        {"training_seed": seed, "rows": [learning_row(100), learning_row(400 * (seed + 1), unsafe=0.0, relaxed=0.5)],
         "judged": {"goals": [float(2 * seed)]}}
        for seed in range(seeds)
    ]  # fmt: skip
    told = point_learning._account(done)
    assert told["steps"] == {1: 400, 2: 1200, 3: 2400}[seeds]
    assert (told["unsafe"], told["goals"], told["relaxed"]) == (seeds, 4.0 * seeds, 5.5 * seeds)
    assert (told["episodes"], told["safe_episodes"]) == (20.0 * seeds, 18.0 * seeds)
    assert told["safe_95"] == list(wilson_interval(18 * seeds, 20 * seeds))
    assert list(told["rows"]) == list(told["judged"]) == [str(seed) for seed in range(seeds)]
    mean, half = {1: (0.0, None), 2: (1.0, 12.7062), 3: (2.0, 4.30265 * 2.0 / 3.0**0.5)}[seeds]
    if half is None:
        assert told["goals_at_the_end"] is None
    else:
        assert told["goals_at_the_end"] == pytest.approx([mean, mean - half, mean + half], abs=1e-3)


def test_without_a_whole_episode_there_is_no_share_of_safe_ones() -> None:
    rows = [learning_row(100, episodes=0.0, safe_episodes=0.0)]
    done = [{"training_seed": 1, "rows": rows, "judged": {"goals": [1.0]}}]
    assert point_learning._account(done)["safe_95"] is None


@pytest.mark.parametrize(
    ("counts", "first", "last"),
    [
        (range(10), 0.5, 8.5),  # the first two and the last two of ten
        (range(5), 0.0, 4.0),
        (range(3), 0.0, 2.0),
        (range(15), 1.0, 13.0),
    ],
)
def test_learning_is_told_by_its_first_and_its_last_fifth(counts: range, first: float, last: float) -> None:
    """Rows of 1000 steps each; of a second seed twice as many."""
    one: list[dict[str, float]] = [{"steps": 1000 * (n + 1), "unsafe": float(n)} for n in counts]
    other = [{"steps": row["steps"], "unsafe": 2.0 * row["unsafe"]} for row in one]
    assert _ends({"1": one}, "unsafe") == (first, last)
    assert _ends({"1": one, "2": other}, "unsafe") == (1.5 * first, 1.5 * last)


@pytest.mark.parametrize("seen", [3, 0])
def test_a_row_of_a_relinearised_filter(seen: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Three directions with two episodes each, of 50 steps, which take 3 s of computing together."""
    towards: list[np.ndarray[Any, Any]] = []

    def driver(_row: Any, given: Any, _seed: int, epsilon: float) -> Any:
        towards.append(given)
        assert epsilon == 0.25
        errors = [np.array([-0.5, 0.25]), np.array([0.1])] if seen else [np.zeros(0)]
        return SimpleNamespace(task=None, seen=lambda: errors, seconds=3.0)

    monkeypatch.setattr(point_relinearised, "_calibrated", lambda _: [np.zeros(4), np.zeros(3)])
    monkeypatch.setattr(point_relinearised, "margins_over_drives", lambda *_: (0.25, None))
    monkeypatch.setattr(point_relinearised, "_driver", driver)
    monkeypatch.setattr(point_relinearised, "drive", lambda *_: EPISODES)
    row = point_relinearised.row_of(point_relinearised.Row("clean", "own", "policy", "", 3, 2, 50, 2, 10, 1, 2))
    assert towards[0] == pytest.approx(np.array([0.0, 0.0, 2.0, 2.0, 4.0, 4.0]) * np.pi / 3.0)
    assert (row["calibrated_on"], row["near"], row["count"]) == (7, seen, 6)
    assert (row["safe"], row["unsafe_steps"], row["safe_each"]) == (4, 25, "101101")
    assert row["safe_interval"] == list(wilson_interval(4, 6))
    assert row["microseconds"] == pytest.approx(10_000.0), "3 s over 300 steps"
    assert (row["median_error"], row["least_room"]) == (0.25 if seen else None, -0.25)
    assert row["error_99"] == (pytest.approx(0.25, abs=0.01) if seen else None)
