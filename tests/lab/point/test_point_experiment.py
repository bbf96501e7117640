"""The experiment in small: pairing of the methods, what is counted, the filter that knows the wind, the report."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from safedpa.errors import InputError
from safedpa_lab.experiments import point
from safedpa_lab.experiments.point import PointExperiment, point_experiment
from safedpa_lab.experiments.point_episodes import DEVELOPMENT, Work
from safedpa_lab.experiments.point_report import against_table, short_table
from safedpa_lab.experiments.seeds import SEEDS
from safedpa_lab.experiments.statistics import ratio_interval
from safedpa_lab.point import drivers
from safedpa_lab.point.driven import PolicyDriver, driven, windy_task
from safedpa_lab.point.drivers import ShieldedDriver, Wheel, driver_of
from safedpa_lab.point.inputs import inputs_of
from safedpa_lab.point.methods import METHODS, Method
from safedpa_lab.point.policy_file import BaselinePolicy, save_policy
from safedpa_lab.point.shield import shield_of
from safedpa_services.command_line import safedpa
from safedpa_sim.point.task import PointTask

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
    one, two = (windy_task(8, 3, FORCE, 5) for _ in range(2))
    np.testing.assert_array_equal(one.layout.hazards, two.layout.hazards)
    np.testing.assert_array_equal(one.simulation.pose, two.simulation.pose)
    force = one.simulation.force
    assert np.linalg.norm(force, axis=0) == pytest.approx(np.full(24, FORCE))
    angle = np.degrees(np.arctan2(force[1], force[0])) % 360.0
    np.testing.assert_allclose(angle.reshape(8, 3), np.repeat(45.0 * np.arange(8), 3).reshape(8, 3), atol=1e-9)


def test_counts_of_an_episode_agree_with_the_task() -> None:
    task = windy_task(4, 2, FORCE, 1)
    found = driven(PolicyDriver(task, Reckless(), inputs_of("lidar", task)), task, 300, np.array([0, 5]))
    assert (found.cost > 0.0).any(), "who drives straight meets a hazard"
    np.testing.assert_array_equal(found.least_room <= 0.0, found.cost > 0.0)
    np.testing.assert_array_equal(np.isfinite(found.first_goal), found.goals > 0.0)
    for shown, robot in zip(found.shown, (0, 5), strict=True):
        assert sum(shown["within"]) == found.cost[robot]
        assert len(shown["places"]) == 300
        assert len(shown["goals"]) == 1 + len(shown["reached_at"]) == 1 + found.goals[robot]


@pytest.mark.long
def test_the_filter_that_knows_the_wind_makes_a_reckless_wish_safe() -> None:
    costs = {}
    for name in ("oracle", "none"):
        task = windy_task(8, 1, FORCE, 2)
        wish = partial(_observed, task)
        driver = ShieldedDriver(task, shield_of(name, task, adapts=""), wish)
        found = driven(driver, task, 150)
        costs[name] = found.cost.sum()
        assert (found.corrected > 0.0) == (name == "oracle")
    assert costs["oracle"] == 0.0
    assert costs["none"] > 20.0


@pytest.mark.long
def test_what_ships_is_safe_behind_the_learned_filter_and_ppo_alone_is_not() -> None:
    found = {}
    for name in ("safedpa", "ppo"):
        task = windy_task(8, 1, FORCE, 7)
        found[name] = driven(driver_of(METHODS[name], task, Wheel(margins={"safedpa": 0.004})), task, 150)
    assert found["safedpa"].cost.sum() == 0.0
    assert found["safedpa"].goals.sum() >= 5.0
    assert found["ppo"].cost.sum() > 0.0


def _untrained(folder: Path) -> None:
    random = np.random.default_rng(0)
    sizes = (31, 64, 64, 2)
    tensors = {}
    for index in range(3):
        tensors[f"policy.{index}.weight"] = random.normal(0.0, 0.2, (sizes[index + 1], sizes[index])).astype(np.float32)
        tensors[f"policy.{index}.bias"] = np.zeros(sizes[index + 1], np.float32)
    for name in ("ppo", "cpo"):
        save_policy(BaselinePolicy(tensors, {}), folder / "seed_0" / f"{name}_wind.safetensors")


@pytest.mark.long
def test_the_command_writes_table_numbers_and_pictures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _untrained(tmp_path)
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
    assert safedpa.run(["experiment", "point", "--methods", "cppo"]) == 2
    assert "did you mean" in capsys.readouterr().err


def test_methods_are_compared_on_seeds_on_which_nothing_was_chosen() -> None:
    """Seeds of margins, of RMA-P's penalty, of kept policies and of what is counted are apart."""
    counted = PointExperiment(Path(), Path(), seed=2300).evaluation
    assert counted in SEEDS["evaluation"]
    assert DEVELOPMENT in SEEDS["development"]
    assert all(seed + extra in SEEDS["development"] for seed in range(5) for extra in (50_000, 51_000))


def _row(goals: list[int], safe: str) -> dict[str, Any]:
    reached = "".join("1" if one else "0" for one in goals)
    told = {"safe": safe.count("1"), "success": reached.count("1"), "both": safe.count("1")}
    return {"goals_each": goals, "safe_each": safe, "success_each": reached, **told}


MARGINS = {"safedpa": 0.002, "mix": 0.012, "safedpa_17": 0.006}


def _found(
    accounts: dict[str, dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> tuple[dict[str, Any], list[tuple[str, float | None]]]:
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
    page = against_table({"advantages": rows, "methods": {"ppo": {"title": "PPO", "told": "lidar"}}})
    assert "| PPO | lidar | +8 -0 | 0.02 |" in page


def test_a_method_with_another_filter_is_driven_with_both_margins_and_safedpa_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rows = dict.fromkeys(("safedpa", "mix", "safedpa_17", "ppo"), _row([1] * 12, "1" * 12))
    result, driven_ = _found(rows, monkeypatch)
    own = [("safedpa", 0.002), ("mix", 0.012), ("safedpa_17", 0.006), ("ppo", None)]
    assert sorted(driven_, key=str) == sorted([*own, ("mix", 0.002), ("safedpa_17", 0.002)], key=str)
    assert {name: row["epsilon"] for name, row in result["methods"].items()} == dict(own)
    assert {name: row["epsilon"] for name, row in result["same_margin"].items()} == dict.fromkeys(own_filters, 0.002)


own_filters = ("safedpa", "mix", "safedpa_17")


@pytest.mark.parametrize("ppo", [[0, 3, 0, 5] * 3, [2, 2, 1, 1] * 3, [0] * 12, None])
def test_goals_over_those_of_ppo_are_reported_where_it_reached_any(
    ppo: list[int] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    goals = {"safedpa": [2, 3, 4, 5] * 3, "mix": [1, 1, 2, 2] * 3} | ({} if ppo is None else {"ppo": ppo})
    result, _ = _found({name: _row(one, "1" * 12) for name, one in goals.items()}, monkeypatch)
    for table, name in (("methods", "safedpa"), ("methods", "mix"), ("same_margin", "mix")):
        if ppo is None or sum(ppo) == 0:
            assert "of_ppo" not in result[table][name]
        else:
            own, others = (np.array(one, dtype=float) for one in (goals[name], ppo))
            assert result[table][name]["of_ppo"] == ratio_interval(own, others)
            assert result[table][name]["of_ppo"][0] == pytest.approx(own.sum() / others.sum())


def test_numbers_that_are_none_are_refused() -> None:
    with pytest.raises(InputError, match="--drives: got 98, wanted 99"):
        PointExperiment(Path(), Path(), drives=98)
    with pytest.raises(InputError, match="--episodes"):
        PointExperiment(Path(), Path(), episodes=0)


def test_a_folder_is_refused_as_a_record_before_margins_are_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
