"""The point robot's experiment: its environment, its margins, what is counted, and the whole in small."""

import json
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.utils.seeding import np_random

from safedpa.errors import InputError
from safedpa_lab.experiments.common.seeds import SEEDS
from safedpa_lab.experiments.common.statistics import ratio_interval, wilson_interval
from safedpa_lab.experiments.point import experiment as point
from safedpa_lab.experiments.point import experiment as point_module
from safedpa_lab.experiments.point import learning as point_learning
from safedpa_lab.experiments.point import relinearised as point_relinearised
from safedpa_lab.experiments.point.experiment import (
    DEVELOPMENT,
    PointExperiment,
    Work,
    account_of,
    best_penalty,
    over_seeds,
    point_experiment,
)
from safedpa_lab.experiments.point.learning import PointLearning, driven_table
from safedpa_lab.experiments.point.report import against_table, short_table
from safedpa_lab.point import drivers, margin
from safedpa_lab.point.baseline_set import BaselinePolicy, save_policy
from safedpa_lab.point.drivers import Driven, PolicyDriver, ShieldedDriver, Wheel, driven, driver_of, evenly, windy_task
from safedpa_lab.point.gym_environment import PointGoalEnvironment
from safedpa_lab.point.inputs import Inputs
from safedpa_lab.point.margin import NEAR, Calibration, measured_margins
from safedpa_lab.point.methods import METHODS, Method
from safedpa_lab.point.online_learning import Learning
from safedpa_lab.point.relinearised import FilteredDriver
from safedpa_lab.point.shield import shield_of
from safedpa_services.command_line import safedpa
from safedpa_sim.point.layout import draw_layouts
from safedpa_sim.point.task import EPISODE_STEPS, PointTask

FORCE = 0.008
NOWHERE = Path("no weights here")
"""So that those that ship are taken."""


def towards_goal(seen: np.ndarray) -> np.ndarray:
    """Straight to the goal, whatever lies there."""
    off = np.arctan2(seen[:, 13], seen[:, 12])
    thrust = np.clip(1.5 * np.cos(off) * seen[:, 14], -1.0, 1.0)
    return np.stack((thrust, np.clip(2.0 * off, -1.0, 1.0)), axis=1)


def _observed(task: PointTask, _: np.ndarray) -> np.ndarray:
    return towards_goal(task.observation())


class Reckless:
    def act(self, observation: np.ndarray) -> np.ndarray:
        return towards_goal(observation)


def test_every_direction_has_its_robots_and_every_method_the_same_world() -> None:
    one, two = (windy_task(evenly(8, 3), FORCE, 5) for _ in range(2))
    np.testing.assert_array_equal(one.layout.hazards, two.layout.hazards)
    np.testing.assert_array_equal(one.simulation.pose, two.simulation.pose)
    force = one.simulation.force
    assert np.linalg.norm(force, axis=0) == pytest.approx(np.full(24, FORCE))
    angle = np.degrees(np.arctan2(force[1], force[0])) % 360.0
    np.testing.assert_allclose(angle.reshape(8, 3), np.repeat(45.0 * np.arange(8), 3).reshape(8, 3), atol=1e-9)


def test_counts_of_an_episode_agree_with_the_task() -> None:
    task = windy_task(evenly(4, 2), FORCE, 1)
    found = driven(PolicyDriver(task, Reckless(), Inputs("lidar", task)), task, 300, np.array([0, 5]))
    assert (found.cost > 0.0).any(), "who drives straight meets a hazard"
    np.testing.assert_array_equal(found.least_room <= 0.0, found.cost > 0.0)
    np.testing.assert_array_equal(np.isfinite(found.first_goal), found.goals > 0.0)
    for shown, robot in zip(found.shown, (0, 5), strict=True):
        assert (sum(shown["within"]), len(shown["places"])) == (found.cost[robot], 300)
        assert len(shown["goals"]) == 1 + len(shown["reached_at"]) == 1 + found.goals[robot]


@pytest.mark.long
def test_the_filter_that_knows_the_wind_makes_a_reckless_nominal_action_safe() -> None:
    costs = {}
    for name in ("oracle", "none"):
        task = windy_task(evenly(8, 1), FORCE, 2)
        nominal = partial(_observed, task)
        driver = ShieldedDriver(task, shield_of(name, task, adapts=""), nominal)
        found = driven(driver, task, 150)
        costs[name] = found.cost.sum()
        assert (found.corrected > 0.0) == (name == "oracle")
    assert costs["oracle"] == 0.0
    assert costs["none"] > 20.0


@pytest.mark.long
def test_what_ships_is_safe_behind_the_learned_filter_and_ppo_alone_is_not() -> None:
    found = {}
    for name in ("safedpa", "ppo"):
        task = windy_task(evenly(8, 1), FORCE, 7)
        found[name] = driven(driver_of(METHODS[name], task, Wheel(margins={"safedpa": 0.004})), task, 150)
    assert found["safedpa"].cost.sum() == 0.0
    assert found["safedpa"].goals.sum() >= 5.0
    assert found["ppo"].cost.sum() > 0.0


@pytest.mark.long
def test_the_command_writes_table_numbers_and_pictures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    random = np.random.default_rng(0)
    sizes = (31, 64, 64, 2)
    tensors = {}
    for index in range(3):
        tensors[f"policy.{index}.weight"] = random.normal(0.0, 0.2, (sizes[index + 1], sizes[index])).astype(np.float32)
        tensors[f"policy.{index}.bias"] = np.zeros(sizes[index + 1], np.float32)
    for name in ("ppo", "cpo"):
        save_policy(BaselinePolicy(tensors, {}), tmp_path / "seed_0" / f"{name}_wind.safetensors")
    options = ["--methods", "ppo, cpo", "--baselines", str(tmp_path), "--processes", "1", "--steps", "60"]
    small = ["--directions", "4", "--episodes", "2"]
    assert safedpa.run(["experiment", "point", *options, *small, "--out", str(tmp_path / "out")]) == 0
    assert "| CPO, limit 25 |" in capsys.readouterr().out
    result = json.loads((tmp_path / "out" / "point.json").read_text())
    assert set(result["methods"]) == {"ppo", "cpo"}
    assert result["methods"]["cpo"]["goals"] == result["methods"]["ppo"]["goals"], "the same policy, the same world"
    assert len(list((tmp_path / "out").glob("*.png"))) == 3
    short = short_table(result, "methods").splitlines()
    assert [line.split("|")[1:4] for line in short[2:]] == [
        [" PPO ", " lidar ", "  "],
        [" CPO, limit 25 ", " lidar ", "  "],
    ]


def test_methods_are_compared_on_seeds_on_which_nothing_was_chosen() -> None:
    """Seeds of margins, of RMA-P's penalty, of kept policies and of what is counted are apart."""
    counted = PointExperiment(Path(), Path(), seed=2300).evaluation
    assert counted in SEEDS["evaluation"]
    assert DEVELOPMENT in SEEDS["development"]
    assert all(seed + extra in SEEDS["development"] for seed in range(5) for extra in (50_000, 51_000))


def _row(goals: list[int], safe: str) -> dict[str, Any]:
    reached = "".join("1" if one else "0" for one in goals)
    reported = {"safe": safe.count("1"), "success": reached.count("1"), "both": safe.count("1")}
    return {"goals_each": goals, "safe_each": safe, "success_each": reached, **reported}


MARGINS = {"safedpa": 0.002, "mix": 0.012, "safedpa_17": 0.006}


def _found(accounts: dict[str, dict[str, Any]], monkeypatch: pytest.MonkeyPatch):
    """The experiment of those methods in four directions, their margins and accounts as written; what was driven."""
    driven_: list[Work] = []

    def account_of(work: Work) -> dict[str, Any]:
        driven_.append(work)
        return {"account": accounts[work.method]}

    measured = {"margins": {name: {"epsilon": epsilon} for name, epsilon in MARGINS.items()}}
    monkeypatch.setattr(point, "measured_margins", lambda _: measured)
    monkeypatch.setattr(point, "account_of", account_of)
    monkeypatch.setattr(point, "training_seeds", lambda *_: (None,))
    result = point_experiment(PointExperiment(NOWHERE, NOWHERE, tuple(accounts), 4, 3, processes=1))
    assert len({work.weights for work in driven_}) == len({METHODS[name].baseline for name in accounts})
    return result, [(work.method, work.epsilon) for work in driven_]


def test_the_advantage_is_that_of_the_exact_tests_in_the_same_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    ours, other = _row([2] * 12, "1" * 12), _row([3] * 12, "0" * 8 + "1" * 4)
    rows = _found({"safedpa": ours, "ppo": other}, monkeypatch)[0]["advantages"]
    safe = next(row for row in rows if row["outcome"] == "safe")
    assert (safe["only_safedpa"], safe["only_other"]) == (8, 0)
    assert safe["mcnemar"] == pytest.approx(2 * 0.5**8)
    assert safe["mcnemar_holm"] == pytest.approx(3 * safe["mcnemar"])
    assert safe["goals"] == pytest.approx([-1.0, -1.0, -1.0])
    page = against_table({"advantages": rows, "methods": {"ppo": {"title": "PPO", "reported": "lidar"}}})
    assert "| PPO | lidar | +8 -0 | 0.02 |" in page


def test_a_method_with_another_filter_is_driven_with_both_margins_and_safedpa_once(monkeypatch) -> None:
    rows = dict.fromkeys(("safedpa", "mix", "safedpa_17", "ppo"), _row([1] * 12, "1" * 12))
    result, driven_ = _found(rows, monkeypatch)
    own = [("safedpa", 0.002), ("mix", 0.012), ("safedpa_17", 0.006), ("ppo", None)]
    assert sorted(driven_, key=str) == sorted([*own, ("mix", 0.002), ("safedpa_17", 0.002)], key=str)
    assert {name: row["epsilon"] for name, row in result["methods"].items()} == dict(own)
    assert {name: row["epsilon"] for name, row in result["same_margin"].items()} == dict.fromkeys(MARGINS, 0.002)


@pytest.mark.parametrize("ppo", [[0, 3, 0, 5] * 3, [2, 2, 1, 1] * 3, [0] * 12, None])
def test_goals_over_those_of_ppo_are_reported_where_it_reached_any(ppo, monkeypatch) -> None:
    goals = {"safedpa": [2, 3, 4, 5] * 3, "mix": [1, 1, 2, 2] * 3} | ({} if ppo is None else {"ppo": ppo})
    result, _ = _found({name: _row(one, "1" * 12) for name, one in goals.items()}, monkeypatch)
    for table, name in (("methods", "safedpa"), ("methods", "mix"), ("same_margin", "mix")):
        if ppo is None or sum(ppo) == 0:
            assert "of_ppo" not in result[table][name]
        else:
            own, others = (np.array(one, dtype=float) for one in (goals[name], ppo))
            assert result[table][name]["of_ppo"] == ratio_interval(own, others)
            assert result[table][name]["of_ppo"][0] == pytest.approx(own.sum() / others.sum())


@pytest.mark.parametrize(
    ("mistaken", "reported"),
    [
        (lambda: PointExperiment(Path(), Path(), drives=98), "--drives: got 98, wanted 99"),
        (lambda: PointExperiment(Path(), Path(), episodes=0), "--episodes"),
        (lambda: Calibration("safedpa", NOWHERE, 20, 10), "--drives: got 20, wanted 99"),
        (lambda: PointGoalEnvironment(force=(1.0,)), "finite"),
        (lambda: PointGoalEnvironment(force=(np.nan, 0.0)), "finite"),
        (lambda: PointGoalEnvironment(largest_force=-1.0), "finite"),
        (lambda: PointGoalEnvironment().step(np.zeros(2)), "call reset first"),
    ],
)
def test_what_cannot_be_is_refused(mistaken, reported) -> None:
    with pytest.raises(InputError, match=reported):
        mistaken()


def test_a_folder_is_refused_as_a_record_before_margins_are_measured(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(point, "measured_margins", lambda _: pytest.fail("margins were measured first"))
    folder = tmp_path / "folder"
    folder.mkdir()
    with pytest.raises(InputError, match="folder: cannot be kept as a record"):
        point_experiment(PointExperiment(NOWHERE, NOWHERE, ("safedpa",), 2, 1, record=folder))
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]


def test_methods_without_weights_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    some = {name: METHODS[name] for name in ("ppo", "oracle", "seeker")}
    monkeypatch.setattr(drivers, "METHODS", {**some, "none": Method("none", "None", policy="never_trained")})
    assert drivers.with_weights(NOWHERE, NOWHERE) == tuple(some)


INF = float("inf")


def driven_accounts(first_goal: tuple[float, ...] = (INF, 2.0, 4.0, INF, INF, 3.0)) -> Driven:
    """Two directions, three episodes each, of 50 steps. Safe are 0, 2, 3 and 5; at a goal come 0, 1, 3 and 5."""
    return Driven(
        goals=np.array([1.0, 2.0, 0.0, 3.0, 0.0, 1.0]), reward=np.arange(6.0),
        cost=np.array([0.0, 5.0, 0.0, 0.0, 20.0, 0.0]), least_room=np.array([0.4, -0.1, 0.2, 0.3, 0.5, -0.3]),
        first_goal=np.array(first_goal), corrected=0.25, relaxed=0.125, processor_seconds=0.6, shown=[],
    )  # fmt: skip


def account(monkeypatch: pytest.MonkeyPatch, found: Driven) -> dict[str, Any]:
    monkeypatch.setattr(point_module, "drive", lambda *_: found)
    reported = account_of(Work("oracle", "", "", "", None, 0.002, 2, 3, 50, 0.008, 1))
    assert (reported["method"], reported["epsilon"], reported["steps"]) == ("oracle", 0.002, 50)
    row: dict[str, Any] = reported["account"]
    return row


def test_each_number_of_six_episodes_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    row = account(monkeypatch, driven_accounts())
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
def test_the_median_of_the_first_goal_is_never_where_half_never_came(first_goal, median, monkeypatch) -> None:
    assert account(monkeypatch, driven_accounts(first_goal))["first_goal_median"] == median


def test_the_best_penalty_has_the_highest_return_less_cost() -> None:
    def one(reward: float, cost: float, safe: int) -> dict[str, Any]:
        return {"reward": [reward, 0.0, 9.0], "cost": [cost, 0.0, 9.0], "safe_episodes": safe}

    reported = best_penalty({"much": one(20.0, 15.0, 1), "best": one(12.0, 5.0, 2), "none": one(6.0, 0.0, 9)})
    assert reported["chosen"] == "best"
    assert {name: row["score"] for name, row in reported["rows"].items()} == {"much": 5.0, "best": 7.0, "none": 6.0}
    assert reported["seed"] in SEEDS["development"]


def test_several_training_seeds_have_students_interval_over_seeds() -> None:
    """Shares of 1/2 and 3/4, goals of 1 and 3: 12.706 deviations of the mean, 0.125 and 1."""
    accounts = {
        5: {"safe_episodes": 10, "episodes": 20, "goals": [1.0, 0.0, 2.0], "cost": [4.0, 0.0, 9.0]},
        7: {"safe_episodes": 30, "episodes": 40, "goals": [3.0, 0.0, 9.0], "cost": [4.0, 0.0, 9.0]},
    }
    reported = over_seeds(accounts)
    assert reported["training_seeds"] == [5, 7]
    assert reported["safe"] == pytest.approx([0.625, 0.625 - 1.58828, 0.625 + 1.58828], abs=1e-4)
    assert reported["goals"] == pytest.approx([2.0, 2.0 - 12.7062, 2.0 + 12.7062], abs=1e-3)
    assert (reported["cost"], reported["each"]) == ([4.0, 4.0, 4.0], [[0.5, 1.0, 4.0], [0.75, 3.0, 4.0]])


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
def test_all_steps_of_all_training_seeds_are_added_up(seeds, steps, goals, monkeypatch) -> None:
    reported, _ = learnt(seeds, monkeypatch)
    assert reported["steps"] == steps
    assert (reported["unsafe"], reported["goals"], reported["relaxed"]) == (seeds, 4.0 * seeds, 5.5 * seeds)
    assert (reported["episodes"], reported["safe_episodes"]) == (20.0 * seeds, 18.0 * seeds)
    assert reported["safe_95"] == list(wilson_interval(18 * seeds, 20 * seeds))
    assert list(reported["rows"]) == list(reported["judged"]) == [str(seed) for seed in range(seeds)]
    if goals is None:
        assert reported["goals_at_the_end"] is None
    else:
        mean, half = goals
        assert reported["goals_at_the_end"] == pytest.approx([mean, mean - half, mean + half], abs=1e-3)


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
        return driven_accounts()

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


@pytest.mark.parametrize("options", [{}, {"force": (0.004, -0.004)}, {"largest_force": 0.008, "stock": True}])
@pytest.mark.filterwarnings("ignore:.*Box observation space m.*imum value is.*infinity")
def test_gymnasium_finds_nothing_wrong(options: dict) -> None:
    made = gymnasium.make("safedpa_lab.point.gym_environment:safedpa/PointGoal-v0", **options)
    check_env(made.unwrapped, skip_render_check=True)


def test_one_robot_in_mujoco_lives_as_one_of_many() -> None:
    """The layout, the heading and the wind are drawn in turn from the generator that the seed gives."""
    one, many, (drawn, _) = PointGoalEnvironment(largest_force=0.008), PointTask(1, 0), np_random(3)
    seen, info = one.reset(seed=3)
    layout = draw_layouts(1, drawn)
    many.layout.goal[:], many.layout.hazards[:] = layout.goal, layout.hazards
    many.simulation.pose[:, 0] = *layout.robot[0], drawn.uniform(0.0, 2.0 * np.pi)
    many.simulation.force[:, 0] = info["force"]
    assert 0.0 < np.linalg.norm(info["force"]) <= 0.008
    np.testing.assert_allclose(seen[12:], many.observation()[0, 12:], atol=1e-5)
    random = np.random.default_rng(1)
    for step in range(150):
        action = random.uniform(-1.0, 1.0, 2) * 0.5 + np.array([0.3, 0.2])
        seen, reward, ended, _, info = one.step(action)
        stepped = many.advance(action[np.newaxis])
        if step:  # the goal of the many was put elsewhere before their first step
            assert reward == pytest.approx(stepped.reward[0], abs=1e-6)
        assert info["cost"] == stepped.cost[0]
        assert not ended
        np.testing.assert_allclose(seen, many.observation()[0], atol=1e-3)


def test_a_goal_that_is_reached_counts_one_and_is_put_elsewhere() -> None:
    environment, info = PointGoalEnvironment(), {"reached": False}
    seen, _ = environment.reset(seed=3)
    while not info["reached"]:
        off, away = np.arctan2(seen[13], seen[12]), seen[14]
        action = np.array([1.5 * np.cos(off) * away, 2.0 * off]).clip(-1.0, 1.0)
        seen, reward, _, timed_out, info = environment.step(action)
        assert not timed_out
    assert (info["goals"], reward) == (1, pytest.approx(1.0, abs=0.05))
    assert seen[14] > 0.4 > away


def test_an_episode_ends_by_time_and_the_force_stays() -> None:
    environment = PointGoalEnvironment(force=(0.003, 0.001))
    for seed in (0, 1):
        environment.reset(seed=seed)
        lengths = 1
        while not environment.step(np.zeros(2))[3]:
            lengths += 1
        assert lengths == EPISODE_STEPS
        np.testing.assert_array_equal(environment.step(np.zeros(2))[4]["force"], [0.003, 0.001])


@pytest.mark.long
def test_a_filter_with_the_wrong_wind_needs_more_room(monkeypatch: pytest.MonkeyPatch) -> None:
    """The whole rule, with a coverage that few drives are enough for."""
    monkeypatch.setattr(margin, "COVERAGE", 0.8)
    found = measured_margins(Calibration("safedpa,mix", NOWHERE, drives=6, steps=60))["margins"]
    assert 0.0 < found["safedpa"]["epsilon"] < found["mix"]["epsilon"] < 0.05
    for row in found.values():
        assert row["drives"] == 6
        assert row["epsilon"] <= row["of_a_drive"]
        assert all(seed in SEEDS["calibration"] for seed in row["seeds"])


@pytest.mark.long
def test_errors_are_what_was_predicted_less_what_was_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the truth known the steering's lag alone is left; without the wind the filter is off by more."""
    monkeypatch.setattr(margin, "COVERAGE", 0.6)
    found = measured_margins(Calibration("oracle,physics", NOWHERE, drives=4, steps=60))["margins"]
    reported, ignorant = found["oracle"], found["physics"]
    assert (reported["drives"], reported["steps"]) == (4, 60)
    assert 5 < reported["transitions"] < 4 * 60, "those near hazards alone"
    assert abs(reported["largest_error"]) < 0.005
    assert reported["median_error"] < ignorant["median_error"] < NEAR
