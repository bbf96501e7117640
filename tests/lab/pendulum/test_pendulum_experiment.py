"""The pendulum's experiments in small, with the models that ship, and what the pages say of the recorded one."""

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa.adaptation import AdaptationNode
from safedpa.bus import ReceivedMessage
from safedpa.dynamics import PhysicsModel, Setting, fingerprint, load_model, write_model
from safedpa.effects import effect
from safedpa.errors import InputError
from safedpa.policy import PolicyNode
from safedpa.records import Run
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety import MarginCalibration
from safedpa.safety.batch.barriers import CompiledBatchBarriers
from safedpa.safety.batch.filter import BatchFilter
from safedpa.safety.defaults import settings_named
from safedpa_lab.experiments.common.seeds import SEEDS
from safedpa_lab.experiments.common.statistics import advantages, wilson_interval
from safedpa_lab.experiments.common.workers import Workers
from safedpa_lab.experiments.pendulum import story as pendulum_payload
from safedpa_lab.experiments.pendulum.episodes import DEVELOPMENT, Choice, Work, accounts, best_penalty
from safedpa_lab.experiments.pendulum.experiment import PendulumExperiment, pendulum_experiment
from safedpa_lab.experiments.pendulum.report import markdown_of
from safedpa_lab.experiments.pendulum.story import (
    PERIOD,
    PayloadCases,
    PendulumStory,
    diagnosed_payload,
    pendulum_story,
    story_markdown,
)
from safedpa_lab.experiments.report import write_report
from safedpa_lab.experiments.table import EXPERIMENTS
from safedpa_lab.pendulum.difficulty import AXES, Difficulty, Episodes
from safedpa_lab.pendulum.margin import covered_share, measured_margins
from safedpa_lab.pendulum.methods import Method, method_named
from safedpa_lab.pendulum.questions import balanced, balanced_account, crossed, crossed_account, sensors_of
from safedpa_lab.pendulum.rollouts import Closed, swung
from safedpa_sim.closed_loop import drive
from safedpa_sim.pendulum.task import BALANCING, TORQUE, WIND, corridor, filter_settings
from safedpa_sim.robots import PendulumRobot, task_named, wind_towards

NOWHERE = Path("no models here")
"""So that those that ship are taken."""


@pytest.mark.long
def test_with_a_margin_that_is_not_its_own_a_fixed_wind_fails() -> None:
    episodes = Episodes(5, 4, 1)
    found = {
        name: balanced_account(balanced(method_named(1, name), NOWHERE, 0.018, episodes, ticks=200), episodes)
        for name in ("safedpa", "fix_45", "oracle")
    }
    assert found["safedpa"]["safe"] == found["oracle"]["safe"] == 4
    assert found["fix_45"]["safe"] < 4
    assert found["safedpa"]["relaxed"] == 0.0


@dataclass
class Small:
    """The whole experiment, run once: its result, the progress that it reported, and the seeds that it drew from."""

    reported: list[tuple[int, int]] = field(default_factory=list)
    calibrated: set[int] = field(default_factory=set)
    """For its margins."""
    chosen: set[int] = field(default_factory=set)
    """For RMA-P's penalty."""
    result: dict[str, Any] = field(default_factory=dict)


@pytest.fixture(scope="module")
def small() -> Small:
    """Both axes at the experiment's own number: a difficulty that axes have in common is run once.

    The four filters of a fixed wind count as one: they differ by that number alone. And what tables and sweeps ask
    alike, the same method with the same margin on the same episodes, is driven once.
    """
    found, plain = Small(), Difficulty()
    own = [axis.values.index(getattr(plain, axis.name)) for axis in SWEPT]
    axes = tuple(
        replace(axis, values=axis.values[at : at + 1], shown=axis.shown[at : at + 1])
        for axis, at in zip(SWEPT, own, strict=True)
    )
    asked = PendulumExperiment(NOWHERE, directions=4, episodes=1, sweep_episodes=1, drives=50, seed=3, axes=axes)

    def margins(filtered: tuple[Method, ...], *given: Any) -> dict[str, dict[str, Any]]:
        with noted(found.calibrated):
            measured = measured_margins(some(filtered), *given)
        return {method.name: measured[method.name if method in some(filtered) else "fix_45"] for method in filtered}

    @cache
    def penalty(choice: Choice) -> dict[str, Any]:
        with noted(found.chosen):
            return best_penalty(choice)

    with pytest.MonkeyPatch.context() as patch, Workers(1) as workers:
        patch.setattr("safedpa_lab.experiments.pendulum.experiment.measured_margins", margins)
        account = each_once(workers)
        patch.setattr("safedpa_lab.experiments.pendulum.experiment.accounts", lambda work, _: map(account, work))
        patch.setattr("safedpa_lab.experiments.pendulum.experiment.best_penalty", penalty)
        found.result = pendulum_experiment(asked, lambda done, every: found.reported.append((done, every)))
    return found


def each_once(workers: Workers) -> Callable[[Work], dict[str, Any]]:
    """The account of a piece of work; of the same one again the same, but for the swings that tables alone show."""
    computed = cache(lambda work: next(accounts([replace(work, shown=True)], workers)))

    def account(work: Work) -> dict[str, Any]:
        method = work.method if some((work.method,)) else replace(work.method, name="fix_45", filter="fix_45")
        reported = deepcopy(computed(replace(work, shown=False, method=replace(method, title="one"))))
        reported["title"] = work.method.title
        return reported if work.shown else {name: value for name, value in reported.items() if name != "shown"}

    return account


def some(methods: tuple[Method, ...]) -> tuple[Method, ...]:
    return tuple(method for method in methods if method.name not in ("fix_135", "fix_225", "fix_315"))


SWEPT = (AXES[1], AXES[3])
"""One of both questions, and one of the second alone."""


@contextmanager
def noted(seeds: set[int]) -> Iterator[None]:
    """The seeds of all episodes that are drawn meanwhile."""
    plain = Episodes.random

    def random(self: Episodes, stream: int) -> np.random.Generator:
        seeds.add(self.seed)
        return plain(self, stream)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Episodes, "random", random)
        yield


@pytest.mark.long
@pytest.mark.slow
def test_each_filter_has_a_margin_of_its_own_by_one_rule(small: Small) -> None:
    methods = [method_named(1, name) for name in ("safedpa", "mix", "oracle")]
    found = {method.name: small.result["margins"][method.name] for method in methods}
    assert {(row["drives"], row["transitions"], row["coverage"]) for row in found.values()} == {(100, 35_000, 0.99)}
    epsilon = {name: row["epsilon"] for name, row in found.items()}
    assert epsilon["oracle"] < 1e-6 < epsilon["safedpa"] < epsilon["mix"], "who knows less pays with a wider one"
    fresh = Episodes(5, 8, 1)
    for method in methods:
        swings = balanced(method, NOWHERE, epsilon[method.name], fresh)
        given = fresh.difficulty.balancing, epsilon[method.name]
        assert balanced_account(swings, fresh)["safe"] == 8
        assert covered_share(method, NOWHERE, swings, fresh.winds(), *given) > 0.98


@pytest.mark.long
@pytest.mark.slow
def test_the_seeds_of_calibration_choice_and_evaluation_are_apart(small: Small) -> None:
    drawn = {"calibration": small.calibrated, "development": small.chosen, "evaluation": set[int]()}
    with noted(drawn["evaluation"]):
        for seed in (0, 2100):
            asked = PendulumExperiment(NOWHERE, seed=seed).evaluation
            balanced(method_named(1, "unfiltered"), NOWHERE, 0.0, asked, ticks=2)
    assert drawn["development"] == {DEVELOPMENT}
    for name, seeds in drawn.items():
        assert seeds, name
        assert seeds <= set(SEEDS[name]), name


def test_the_filter_of_the_experiment_is_the_one_on_the_bus() -> None:
    model, epsilon = load_model("pendulum_learned"), 0.03
    margin = MarginCalibration({"corridor": epsilon}, 0.99, 1000, "2026-11-23", fingerprint(model))
    heard: list[ReceivedMessage] = []
    nodes = [
        AdaptationNode(model),
        PolicyNode(model, controller="random"),
        SafetyFilterNode(model, settings_named("pendulum"), margin),
    ]
    robot = PendulumRobot(task_named("balance"), wind_towards(4.0, 135.0), seed=3)
    ticks = list(drive(robot, nodes, 120, hear=heard.append))
    notice = {name: [one.message for one in heard if one.topic.name == name] for name in ("latent", "nominal")}
    rows = [
        np.array([message.values for message in messages])
        for messages in ([tick.state for tick in ticks], notice["nominal"], notice["latent"])
    ]
    barriers = CompiledBatchBarriers.of([[corridor(BALANCING)]] * len(ticks), 2)
    ours = BatchFilter(model, filter_settings(epsilon)).decide(*rows, barriers=barriers)
    np.testing.assert_allclose(ours.action, [tick.verdict.action for tick in ticks], atol=1e-4)
    assert {tick.verdict.status for tick in ticks} == {"passed", "corrected"}


def test_without_a_filter_the_nominal_action_goes_through() -> None:
    start, wind = np.zeros((1, 2)), np.array([[WIND, 0.0]])
    swings = swung(Closed(), lambda state, _: np.full((len(state), 1), 99.0), start, wind, BALANCING, 40)
    assert swings.states[-1, 0, 0] > BALANCING[1]
    assert swings.torques.max() == TORQUE, "the motor's bound"


def test_the_same_draws_for_every_method() -> None:
    episodes = Episodes(6, 4, 1, Difficulty(noise=0.01))
    one, two = (balanced(method_named(1, "mix"), NOWHERE, 0.018, episodes, ticks=20) for _ in range(2))
    np.testing.assert_array_equal(one.states, two.states)
    other = balanced(method_named(1, "safedpa"), NOWHERE, 0.018, episodes, ticks=20)
    np.testing.assert_allclose(one.seen - one.states, other.seen - other.states, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("axis", AXES, ids=lambda axis: axis.name)
def test_each_axis_makes_its_own_number_harder(axis) -> None:  # type: ignore[no-untyped-def]
    plain = Difficulty()
    assert getattr(plain, axis.name) in axis.values
    for value in axis.values:
        assert replace(axis.at(value), **{axis.name: getattr(plain, axis.name)}) == plain
    assert len(axis.ticks) == len(axis.values)


def test_what_is_asked_is_what_happens() -> None:
    hard = Difficulty(wind=3.0, torque=6.0, corridor=0.3, hazard=0.2, noise=0.02)
    episodes = Episodes(7, 4, 2, hard)
    np.testing.assert_allclose(np.linalg.norm(episodes.winds(), axis=1), 3.0)
    swings = balanced(method_named(1, "safedpa"), NOWHERE, 0.02, episodes, ticks=30)
    assert np.abs(swings.torques).max() <= 6.0
    assert (swings.seen - swings.states).std() == pytest.approx(0.02, rel=0.15)
    account = balanced_account(swings, episodes)
    assert max(account["least_room"]) < 0.3
    quiet = Episodes(7, 4, 2)
    np.testing.assert_array_equal(sensors_of(quiet)(swings.states[0]), swings.states[0])
    assert hard.in_hazard(np.array([0.1, 0.3])).tolist() == [False, True]
    passed = crossed_account(crossed(method_named(2, "goal_seeker"), NOWHERE, 0.03, quiet), quiet)
    assert passed["both"] == 8


@pytest.mark.long
@pytest.mark.slow
def test_the_whole_experiment_in_small(small: Small, tmp_path: Path) -> None:
    reported, result = small.reported, small.result
    whole = (8 + 15) + (7 + 8) + 7 + (7 + 4)  # with own margins, with the same one, and both questions of the sweeps
    assert reported == [(done + 1, whole) for done in range(whole)]
    assert "| SafeDPA | " in markdown_of(result)
    write_report(EXPERIMENTS["pendulum"], result, {"out": tmp_path})
    written = json.loads((tmp_path / "pendulum.json").read_text())
    assert written["tables"]["own"]["hazard"]["safedpa"]["both"] == 4
    assert all(row["safe"] == 4 for name, row in written["tables"]["own"]["balancing"].items() if name != "unfiltered")
    own = {name: row["epsilon"] for name, row in written["tables"]["own"]["balancing"].items()}
    assert own == {**{name: row["epsilon"] for name, row in written["margins"].items()}, "unfiltered": None}
    same = {row["epsilon"] for row in written["tables"]["same"]["hazard"].values()}
    assert same == {written["margins"]["safedpa"]["epsilon"]}
    assert written["sweeps"]["hazard"]["hazard"]["rma_p"]["chosen"][0].startswith("rma_p_")
    assert written["penalty"]["seed"] in SEEDS["development"]
    assert written["evaluation_seed"] in SEEDS["evaluation"]
    assert 2.5 < written["invariance"]["largest_wind"]["balancing"] < 3.1, "with the margin that fifty drives ask for"
    assert 5.0 < written["invariance"]["without_margin"]["balancing"] < 5.2
    margin = MarginCalibration.load(tmp_path / "margin.toml")
    assert margin.fingerprint == fingerprint(load_model("pendulum_learned"))
    assert len(list(tmp_path.glob("*.png"))) == 5


@pytest.fixture
def result(repository: Path) -> Any:
    return json.loads((repository / "docs" / "evidence" / "results" / "pendulum.json").read_text(encoding="utf-8"))


def test_its_counts_are_those_of_its_flags(result: Any) -> None:
    for table in result["tables"].values():
        for rows in table.values():
            for row in rows.values():
                assert row["episodes"] == len(row["safe_each"]) == result["directions"] * result["episodes"]
                assert row["safe"] == row["safe_each"].count("1")
                assert row["interval_safe"] == pytest.approx(wilson_interval(row["safe"], row["episodes"]))
                if "success_each" in row:
                    pairs = list(zip(row["safe_each"], row["success_each"], strict=True))
                    assert row["both"] == pairs.count(("1", "1"))


def test_its_significance_follows_from_its_flags(result: Any) -> None:
    for name, table in result["tables"].items():
        assert advantages(table, result["directions"]) == result["advantages"][name]


def test_it_was_counted_on_seeds_of_its_own(result: Any) -> None:
    assert result["evaluation_seed"] in SEEDS["evaluation"]
    assert result["seed"] >= 100, "below 100 one develops"
    assert result["penalty"]["seed"] in SEEDS["development"]
    margins = result["margins"].values()
    assert all(seed in SEEDS["calibration"] for row in margins for seed in row["seeds"])
    assert len({(row["drives"], row["transitions"], row["coverage"]) for row in margins}) == 1
    assert result["provenance"]["command"].startswith("safedpa experiment pendulum --seed 2100")


def test_the_claims_are_its_figures(repository: Path, result: Any) -> None:
    own, same = result["tables"]["own"], result["tables"]["same"]
    others = [name for name in own["balancing"] if name.startswith("fix_")] + ["mix"]
    count = own["balancing"]["safedpa"]["episodes"]
    claims = " ".join((repository / "docs" / "evidence" / "claims.md").read_text(encoding="utf-8").split())
    assert all(own["balancing"][name]["safe"] == count for name in ("safedpa", *others))
    upright = [own["hazard"][name]["both"] for name in others]
    retained = [same["balancing"][name]["safe"] for name in others]
    both = own["hazard"]["safedpa"]["both"]
    assert f"every filter with its own margin {count} of {count} without a violation" in claims
    assert f"with SafeDPA's margin for all the others {min(retained)} to {max(retained)}" in claims
    assert f"SafeDPA {both} of {count} upright and never in the hazard" in claims
    assert f"filters that do not adapt {min(upright)} to {max(upright)}" in claims


@pytest.mark.long
def test_a_payload_is_found_and_the_corrected_model_needs_less_margin() -> None:
    story = PendulumStory(
        hidden=("payload",), directions=2, episodes=1, seconds=1.2, swings=2, swing_seconds=8.0, processes=1
    )
    result = pendulum_story(story)
    case = result["cases"]["payload"]
    assert case["added"] == ["tip_mass"]
    assert case["values"]["tip_mass.mass"]["value"] == pytest.approx(0.5, abs=0.01)
    assert case["error"][-1] < 0.1 * case["error"][0]
    rows = case["rows"]
    assert rows["diagnosed"]["margin"] < 0.5 * rows["shipped"]["margin"]
    assert rows["diagnosed"]["reach"] > rows["shipped"]["reach"]
    assert all(row["safe"] == 2 for row in rows.values())
    assert "added tip_mass 0.5" in story_markdown({**result, "date": "today"})


def identified() -> str:
    """Not the identification, which needs the real logs: a pendulum of about its numbers.

    Without friction nothing could tell a payload from a weaker motor: both scale the torque alone.
    """
    friction = effect("pendulum", "coulomb_friction")
    model = load_model("dfki_pendulum").with_effect(friction, {"torque": Setting(0.19)})
    return write_model(model.with_settings({path: Setting(item.value) for path, item in model.settings.items()}))


@pytest.mark.parametrize(
    ("value", "std", "within"),
    [
        (0.25, 0.03, True), (0.15, 0.03, True), (0.2, 0.001, True), (0.25, 0.02, False), (0.15, 0.02, False),
        (0.2, None, False), (None, None, False),
    ],
)  # fmt: skip
def test_a_payload_is_found_where_its_mass_lies_within_two_of_the_stated_deviations(value, std, within, monkeypatch):
    """Hidden are 0.2 kg."""
    named = {} if value is None else {"tip_mass.mass": SimpleNamespace(value=value, std=std)}
    found = SimpleNamespace(parameters=named, added=list(named), stages=[SimpleNamespace(heldout_error=0.5)])
    logs = []

    def diagnose(_: PhysicsModel, runs: list[Run], __: float) -> Any:
        logs.extend(runs)
        return found

    monkeypatch.setattr(pendulum_payload, "diagnose", diagnose)
    row = diagnosed_payload((identified(), 0.2, 3, 2, 1.0))
    assert row["within"] is within
    assert (row["value"], row["std"], row["mass"], row["seed"]) == (value, std, 0.2, 3)
    assert [run.t[-1] for run in logs] == pytest.approx([1.0 - PERIOD] * 2)
    assert not np.array_equal(logs[0].actions, logs[1].actions)


@pytest.mark.long
def test_a_users_payload_is_named_and_weighed() -> None:
    row = diagnosed_payload((identified(), 0.2, 0, 2, 12.0))
    assert row["added"] == ["tip_mass"]
    assert row["within"], row


def test_mistakes_are_named(tmp_path) -> None:
    with pytest.raises(InputError, match="--directions: got 0"):
        PendulumStory(directions=0)
    with pytest.raises(InputError, match="wanted logs of DFKI's pendulum"):
        PayloadCases(tmp_path)
