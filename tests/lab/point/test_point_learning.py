"""A policy that goes on learning: counts by hand, inputs of the policies, the same start without the filter."""

import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from safedpa.errors import InputError
from safedpa_lab.experiments.common.seeds import SEEDS
from safedpa_lab.experiments.point import learning as experiment
from safedpa_lab.experiments.point.learning import (
    MARGIN,
    PointLearning,
    driven_table,
    judged_table,
    per_thousand,
    point_learning,
    smoothed,
)
from safedpa_lab.point import online_learning
from safedpa_lab.point.baseline_set import BaselinePolicy, baseline_named
from safedpa_lab.point.baselines import policy_of
from safedpa_lab.point.drivers import driven
from safedpa_lab.point.online_learning import COUNTS, STARTS, Learning, Tally, learned, learning_environment
from safedpa_lab.point.shield import LearningShield, Shield, shield_of
from safedpa_services.command_line import safedpa
from safedpa_sim.point.task import EPISODE_STEPS, PointTask, StepResult

LEARNING = Learning("shipped", MARGIN, 0, 5, 6, 2048, 16, 1, 0.008)
JUDGED_STEPS = 5
PAGES = Path(__file__).parents[3] / "docs" / "evidence"


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Policies are judged in a few steps."""
    monkeypatch.setattr(online_learning, "driven", partial(driven, steps=JUDGED_STEPS))


def stepped(cost: tuple[int, int], reached: tuple[int, int], over: tuple[int, int]) -> StepResult:
    costs, goals, ends = (np.array(given) for given in (cost, reached, over))
    return StepResult(0.5 + goals, costs.astype(float), goals.astype(bool), ends.astype(bool))


def test_counts_of_a_drive_that_is_written_down_by_hand() -> None:
    """Two robots: the second's third episode alone is whole, reaches two goals and is unsafe twice."""
    tally, no = Tally(2), np.zeros(2, bool)
    tally.add(stepped((1, 0), (0, 0), (0, 0)), np.array([True, True]), np.array([True, False]))
    tally.add(stepped((0, 1), (1, 0), (0, 1)), no, no)
    tally.close_row()
    tally.add(stepped((0, 1), (0, 1), (0, 0)), np.array([False, True]), no)
    tally.add(stepped((0, 1), (0, 1), (1, 1)), no, no)
    tally.add(stepped((0, 0), (1, 0), (1, 0)), no, no)
    tally.close_row()
    first, second = tally.rows
    assert first == {
        **{"steps": 4, "unsafe": 2.0, "goals": 1.0, "reward": 3.0, "corrected": 2.0, "relaxed": 1.0},
        **{"episodes": 0.0, "safe_episodes": 0.0, "episode_goals": 0.0},
    }
    assert second == {
        **{"steps": 10, "unsafe": 2.0, "goals": 3.0, "reward": 6.0, "corrected": 1.0, "relaxed": 0.0},
        **{"episodes": 2.0, "safe_episodes": 1.0, "episode_goals": 3.0},
    }


@pytest.mark.long
def test_what_is_counted_is_what_the_robots_did(short: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """The sums of the rows, compared with positions that are looked at in another way."""
    within: list[int] = []
    advance = PointTask.advance

    def watched(self: PointTask, action: NDArray[Any]) -> StepResult:
        found = advance(self, action)
        apart = self.layout.hazards - self.simulation.pose[:2].T[:, np.newaxis]
        within.append(int((np.linalg.norm(apart, axis=2).min(axis=1) <= 0.2).sum()))
        return found

    monkeypatch.setattr(PointTask, "advance", watched)
    rows = learned(replace(LEARNING, epsilon=None))["rows"]
    within = within[:-JUDGED_STEPS]
    assert rows[-1]["steps"] == 2048 == 16 * len(within)
    assert sum(row["unsafe"] for row in rows) == sum(within) > 0, "without a filter a learner meets a hazard"


@pytest.mark.long
def test_the_same_seed_requests_the_same_until_the_filter_changes_something(short, monkeypatch) -> None:
    nominal_actions: list[NDArray[Any]] = []
    changed: list[NDArray[Any]] = []
    safe = LearningShield.safe

    def watched(self: LearningShield, chosen: NDArray[Any]) -> NDArray[np.float64]:
        nominal_actions.append(chosen.copy())
        action = safe(self, chosen)
        changed.append(self.corrected.copy())
        return action

    monkeypatch.setattr(LearningShield, "safe", watched)
    found = []
    for epsilon in (MARGIN, None, None):
        nominal_actions, changed = [], []
        learned(replace(LEARNING, epsilon=epsilon))
        found.append((np.array(nominal_actions), np.array(changed)))
    (behind, corrected), (alone, uncorrected), (again, _) = found
    np.testing.assert_array_equal(alone, again)
    assert not uncorrected.any()
    untouched = np.cumsum(corrected, axis=0) - corrected == 0  # also the nominal action that is the first to be changed
    assert 0.1 < untouched.mean() < 1.0
    np.testing.assert_array_equal(behind[untouched], alone[untouched])
    assert not np.array_equal(behind, alone)


def test_policy_and_filter_know_the_same_latent_through_new_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Both of what was carried out, and nothing of the episode before."""
    shields: list[Shield] = []

    def made(*given: Any, **named: Any) -> Shield:
        shields.append(shield_of(*given, **named))
        return shields[-1]

    monkeypatch.setattr(online_learning, "shield_of", made)
    environment, _ = learning_environment(LEARNING)
    task, random = environment.task, np.random.default_rng(0)
    task.steps[:8] = EPISODE_STEPS - 10
    environment.reset()
    seen = []
    for _ in range(30):
        nominal = random.uniform(-1.0, 1.0, (16, 2)).astype(np.float32)
        observed, _, over, _ = environment.step(nominal)
        reported = observed[:, -2:]
        np.testing.assert_allclose(reported, shields[0].see(task), atol=1e-6)
        seen.append((over, reported))
    ended = next(step for step, (over, _) in enumerate(seen) if over[:8].all())
    fresh = seen[ended][1][:8]
    np.testing.assert_allclose(fresh, np.broadcast_to(fresh[0], fresh.shape), atol=0.5)
    assert np.abs(seen[ended][1][:8] - seen[ended - 1][1][:8]).max() > 1e-3


def test_each_episode_has_a_wind_of_full_force_towards_one_of_the_directions() -> None:
    found = []
    for epsilon in (MARGIN, None):
        environment, between = learning_environment(replace(LEARNING, epsilon=epsilon))
        forces = []
        for _ in range(20):
            forces.append(environment.task.simulation.force.copy())
            between.restart(np.arange(16))
        found.append((np.array(forces), environment.task.layout.hazards.copy()))
    (forces, hazards), (others, other_hazards) = found
    np.testing.assert_array_equal(forces, others)
    np.testing.assert_array_equal(hazards, other_hazards)
    np.testing.assert_allclose(np.linalg.norm(forces, axis=1), 0.008)
    steps = np.degrees(np.arctan2(forces[:, 1], forces[:, 0])) / 15.0
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)
    assert len(np.unique(np.round(steps) % 24)) == 24


@pytest.mark.long
@pytest.mark.parametrize(("start", "moves"), [("shipped", False), ("nothing", True)])
def test_a_trained_policy_stays_as_it_is_while_its_critic_is_learned(start, moves, short, monkeypatch) -> None:
    retained: list[dict[str, NDArray[np.float32]]] = []

    def policy(*given: Any) -> BaselinePolicy:
        found = policy_of(*given)
        retained.append(found.tensors)
        return found

    monkeypatch.setattr(online_learning, "policy_of", policy)
    for steps in (0, 2048):
        learned(replace(LEARNING, start=start, epsilon=None, steps=steps))
    before, after = retained
    assert any(not np.array_equal(before[name], after[name]) for name in before) is moves
    if STARTS[start].key:
        shipped = baseline_named(STARTS[start].key, Path()).tensors
        assert all(np.array_equal(before[name], shipped[name]) for name in shipped)


@pytest.mark.long
def test_an_experiment_that_was_cut_off_comes_to_the_same(short: None, tmp_path: Path) -> None:
    asked = PointLearning(("nothing",), steps=2048, seeds=(0,), robots=16)
    whole = point_learning(asked)
    record = tmp_path / "learnings.jsonl"
    assert point_learning(replace(asked, record=record)) == whole
    lines = record.read_text(encoding="utf-8").splitlines(keepends=True)
    assert len(lines) == 1 + 2
    record.write_text("".join(lines[:2]) + lines[2][:40], encoding="utf-8")
    reported: list[tuple[int, int]] = []
    assert point_learning(replace(asked, record=record), lambda done, all_: reported.append((done, all_))) == whole
    assert reported == [(2, 2)], "the learning behind the filter is not done again"


@pytest.mark.long
def test_the_small_experiment_from_the_command_line(short, tmp_path, capsys) -> None:
    phrase = ["--quick", "--starts", "careless", "--out", str(tmp_path), "--json"]
    assert safedpa.run(["experiment", "point-learning", *phrase]) == 0
    reported = json.loads(capsys.readouterr().out)
    result = json.loads((tmp_path / "point-learning.json").read_text(encoding="utf-8"))
    assert result["provenance"]["command"].startswith("safedpa experiment point-learning --starts careless")
    assert reported["starts"] == result["starts"]
    row = result["starts"]["careless"]["filter"]
    assert (row["steps"], len(row["rows"]["0"]), row["judged_before"]["episodes"]) == (4096, 2, 24)
    alone = result["starts"]["careless"]["none"]
    assert row["corrected"] > 0 == alone["corrected"]
    assert row["unsafe"] == 0 < alone["unsafe"]
    assert "PPO that ships" in (tmp_path / "point-learning.md").read_text(encoding="utf-8")
    assert (tmp_path / "point_learning.png").stat().st_size > 10_000


def test_curves_and_tables_by_hand() -> None:
    rows = [{"steps": steps, "goals": goals, "reward": 0.0, "corrected": 0.0} for steps, goals in ((100, 1), (300, 1))]
    steps, values = per_thousand(rows, "goals")
    np.testing.assert_allclose((steps, values), ((50.0, 200.0), (10.0, 5.0)))
    np.testing.assert_allclose(smoothed(np.array([0.0, 3.0, 6.0, 0.0]), 3), [1.5, 3.0, 3.0, 3.0])
    judged = {"goals": [1.5, 1.0, 2.0], "safe": 23, "episodes": 24, "unsafe_steps": 7, "corrected": 0.125}
    row = {"rows": {"4": rows}, "steps": 300, "unsafe": 3, "safe_episodes": 1.0, "episodes": 2.0}
    found = {"starts": {"shipped": {"filter": {**row, "judged": {"4": judged}, "judged_before": judged}}}}
    assert "| 300 | 3 | 10.00 | 1 of 2 | 10.0 | 5.0 | 0.0 | 0.0 | 0.0 | 0.0 |" in driven_table(found)
    lines = judged_table(found).splitlines()[2:]
    assert [line.split(" | ")[2] for line in lines] == ["nothing yet", "seed 4"]
    assert all(line.endswith("| 1.5 (1.0 to 2.0) | 23 of 24 | 7 | 12.5 |") for line in lines)


def test_seeds_are_of_evaluation_and_with_and_without_filter_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    work: list[Learning] = []

    def learning(one: Learning) -> dict[str, Any]:
        work.append(one)
        rows = [dict.fromkeys(("steps", *COUNTS), 0.0)] if one.steps else []
        return {"training_seed": one.training_seed, "rows": rows, "judged": {"goals": [0.0]}}

    monkeypatch.setattr(experiment, "learned", learning)
    point_learning(PointLearning())
    assert {one.steps for one in work if one.start == "nothing"} == {250_000}
    assert [one.steps for one in work if one.start == "shipped"] == [0, 0] + [250_000] * 6, "judged as it is, too"
    assert all(one.layout_seed in SEEDS["evaluation"] and one.judged_seed in SEEDS["evaluation"] for one in work)
    behind, alone = ([one for one in work if (one.epsilon is None) is none] for none in (False, True))
    assert {one.epsilon for one in behind} == {MARGIN}
    assert [replace(one, epsilon=None) for one in behind] == alone
    assert not {one.judged_seed for one in work} & {one.layout_seed for one in work}


def test_the_margin_is_the_one_that_the_experiment_of_the_page_measured() -> None:
    result = json.loads((PAGES / "results" / "point.json").read_text(encoding="utf-8"))
    assert result["margins"]["safedpa"]["epsilon"] == pytest.approx(MARGIN, abs=1e-4)


@pytest.mark.parametrize(
    ("given", "wanted"),
    [
        ({"starts": ("shiped",)}, "did you mean 'shipped'"), ({"starts": ()}, "one or more"),
        ({"seeds": (1, 1)}, "none of them twice"), ({"seeds": (50,)}, "from 0 to 49"), ({"robots": 15}, "16 or more"),
        ({"steps": 0}, "1 or more"), ({"margin": float("nan")}, "0 or more"),
        ({"seed": 99_990}, "seeds for evaluation"),
    ],
)  # fmt: skip
def test_what_makes_no_experiment_is_refused(given: dict[str, Any], wanted: str) -> None:
    with pytest.raises(InputError, match=wanted):
        PointLearning(**given)
