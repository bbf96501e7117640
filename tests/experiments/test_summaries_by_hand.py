"""Rows of experiments from outcomes that are written down by hand: every count, share, mean and interval of them."""

from __future__ import annotations

from math import comb
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.stats import beta

from safedpa.errors import SafedpaError
from safedpa_lab.experiments import (
    car_errors,
    car_latent,
    car_table,
    controllers,
    fleet_diagnosis,
    hidden_horizons,
    hidden_summary,
    live,
    long_drives,
    ros,
    safety,
    safety_pays,
    sensing,
)
from safedpa_lab.experiments.live_drive import LiveDrive
from safedpa_lab.experiments.long_drives import LongOutcome
from safedpa_lab.experiments.statistics import (
    clopper_pearson_interval,
    cluster_interval,
    coverage_row,
    ratio_interval,
    wilson_interval,
)


@pytest.mark.parametrize(("hits", "trials"), [(0, 5), (1, 5), (5, 5), (3, 40), (20, 40), (39, 40), (499, 500)])
def test_at_the_ends_of_wilsons_interval_the_share_lies_two_deviations_away(hits: int, trials: int) -> None:
    """(share - p)^2 = z^2 p (1 - p) / n defines both ends; where the share is 0 or 1 that end is the share itself."""
    share, z = hits / trials, 1.959963984540054
    low, high = wilson_interval(hits, trials)
    assert 0.0 <= low <= share <= high <= 1.0
    for end in (low, high):
        assert (share - end) ** 2 == pytest.approx(z**2 * end * (1.0 - end) / trials, abs=1e-12)
    assert low < high


@pytest.mark.parametrize(("hits", "trials"), [(-1, 4), (5, 4), (0, 0)])
def test_what_is_no_share_has_no_interval(hits: int, trials: int) -> None:
    for interval in (wilson_interval, clopper_pearson_interval):
        with pytest.raises(ValueError, match="wanted 0 <= hits <= trials"):
            interval(hits, trials)


@pytest.mark.parametrize(("hits", "trials"), [(0, 7), (3, 7), (7, 7), (1, 1)])
def test_an_exact_interval_leaves_a_fortieth_on_each_side(hits: int, trials: int) -> None:
    """P(at least so many hits | low) = 0.025 = P(at most so many | high), as sums of binomial terms."""

    def chance(counts: range, p: float) -> float:
        return sum(comb(trials, k) * p**k * (1.0 - p) ** (trials - k) for k in counts)

    low, high = clopper_pearson_interval(hits, trials)
    assert (chance(range(hits, trials + 1), low) if hits else 0.025) == pytest.approx(0.025)
    assert (chance(range(hits + 1), high) if hits < trials else 0.025) == pytest.approx(0.025)


def test_an_interval_over_drives_is_that_of_means_of_whole_drives() -> None:
    """The mean of 50 shares of deviation 0.1 has the deviation 0.1 / sqrt(50)."""
    random = np.random.default_rng(3)
    shares = np.clip(0.5 + 0.1 * random.standard_normal(50), 0.0, 1.0)
    low, high = cluster_interval(shares)
    half = 1.96 * shares.std() / np.sqrt(50.0)
    assert (low, high) == pytest.approx((shares.mean() - half, shares.mean() + half), abs=0.25 * half)
    assert cluster_interval(np.ones(20)) == (pytest.approx(beta.ppf(0.025, 20, 1)), 1.0)
    assert cluster_interval(np.full(20, 0.5))[1] == 0.5
    with pytest.raises(ValueError, match="wanted one at least"):
        cluster_interval(np.array([]))


def test_a_row_of_coverage_counts_the_steps_and_the_drives_that_are_covered_whole() -> None:
    row = coverage_row(np.array([1.0, 0.5, 1.0, 0.9]), 0.125)
    assert (row["epsilon"], row["steps"], row["drives"]) == (0.125, 0.85, 0.5)
    assert row["drives_95"] == list(clopper_pearson_interval(2, 4))
    assert row["steps_95"] == list(cluster_interval(np.array([1.0, 0.5, 1.0, 0.9])))


def test_drives_of_controllers() -> None:
    drives = [
        controllers._Drive(0, 0, 100, 10, (1.0, 2.0)),
        controllers._Drive(3, 2, 300, 50, (3.0,)),
        controllers._Drive(2, 1, 100, 0, (4.0, 5.0)),
        controllers._Drive(0, 0, 100, 0, (3.0,)),
    ]
    assert controllers._summary(drives) == {
        "drives": 4, "goals": 5, "drives_with_a_goal": 2, "collisions": 3,
        "safe_share_95": [round(end, 4) for end in wilson_interval(2, 4)], "changed_share": 0.1,
        "milliseconds_p50": 3.0, "milliseconds_p99": 4.95,
    }  # fmt: skip


def test_what_the_filter_changed_in_a_timed_drive_is_all_that_is_not_passed(monkeypatch: pytest.MonkeyPatch) -> None:
    statuses = ["passed"] * 4 + ["corrected"] * 3 + ["fallback"]
    robot = SimpleNamespace(collisions=[1, 2], goals_reached=3)
    watch = SimpleNamespace(node=None, milliseconds=[1.0, 2.0])
    monkeypatch.setattr(controllers, "_Stopwatch", lambda *_: watch)
    for name in ("AdaptationNode", "SafetyFilterNode", "margin_for"):
        monkeypatch.setattr(controllers, name, lambda *_: None)
    monkeypatch.setattr(controllers, "CarRobot", lambda *_: robot)
    ticks = [SimpleNamespace(verdict=SimpleNamespace(status=status)) for status in statuses]
    monkeypatch.setattr(controllers, "drive", lambda _robot, _nodes, count: ticks[:count])
    found = controllers.timed_drive(None, None, "car", "none", 1, 0.4)  # type: ignore[arg-type]
    assert found == controllers._Drive(3, 2, 8, 4, (1.0, 2.0))


def outcome(load: str, filtered: bool, collisions: int, **changes: Any) -> safety.Outcome:
    usual: dict[str, Any] = {"goals": 2, "ticks": 100, "interventions": 5, "least_h": 0.5, "trajectory": ""}
    return safety.Outcome(
        load=load, filtered=filtered, collisions=collisions, **{**usual, "statuses": {"passed": 1}, **changes}
    )


def test_episodes_with_and_without_the_filter() -> None:
    outcomes = [
        outcome("box", True, 0), outcome("box", True, 3, goals=0, least_h=-0.25, ticks=300, interventions=75),
        outcome("box", True, 2), outcome("box", True, 0, statuses={"fallback": 2, "passed": 4}),
        outcome("box", False, 7), outcome("none", True, 9),
    ]  # fmt: skip
    row = safety._row("box", outcomes)
    assert row["filter_on"] == {
        "episodes": 4, "safe_episodes": 2, "safe_share_95": [round(end, 4) for end in wilson_interval(2, 4)],
        "collisions": 5, "goals": 6, "least_h": -0.25, "intervention_share": 0.15,
        "statuses": {"fallback": 2, "passed": 7},
    }  # fmt: skip
    assert (row["filter_off"]["episodes"], row["filter_off"]["collisions"]) == (1, 7)


def test_episodes_with_an_incomplete_and_with_a_diagnosed_model() -> None:
    model: Any = SimpleNamespace(effects=[SimpleNamespace(name="drag"), SimpleNamespace(name="tow")])
    margin: Any = SimpleNamespace(epsilon={"wall": 0.123456})
    episodes = [
        {"collisions": 0, "least_h": 0.1, "changed": 0.5, "goals": 2, "first_goal": 3.0},
        {"collisions": 2, "least_h": -0.1, "changed": 0.25, "goals": 0, "first_goal": None},
        {"collisions": 1, "least_h": -0.2, "changed": 0.0, "goals": 4, "first_goal": 5.0},
        {"collisions": 0, "least_h": 0.0, "changed": 0.0, "goals": 1, "first_goal": 10.0},
    ]
    assert safety_pays._row("drag", "diagnosed", model, margin, episodes) == {
        "hidden": "drag", "model": "diagnosed", "effects": ["drag", "tow"], "episodes": 4, "safe_episodes": 2,
        "safe_share_95": [round(end, 4) for end in wilson_interval(2, 4)], "collisions": 3, "below_zero": 2,
        "epsilon": {"wall": 0.12346}, "intervention_share": 0.1875, "goals": 7, "first_goal_median": 5.0,
        "first_goal_reached": 3,
    }  # fmt: skip
    nobody = safety_pays._row("drag", "diagnosed", model, margin, episodes[1:2])
    assert (nobody["first_goal_median"], nobody["first_goal_reached"]) == (None, 0)


@pytest.mark.parametrize("reached_at", [None, 1, 4])
def test_an_episode_tells_its_first_goal_what_was_changed_and_the_least_h(
    reached_at: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = SimpleNamespace(collisions=[1], goals_reached=0)
    story = [("passed", 0.5), ("corrected", 0.3), ("fallback", -0.1), ("passed", 0.2), ("passed", 0.4)]

    def driven(*_: Any) -> Any:
        for number, (status, h) in enumerate(story):
            robot.goals_reached = int(reached_at is not None and number >= reached_at)
            yield SimpleNamespace(verdict=SimpleNamespace(status=status, h_now=h))

    for name in ("AdaptationNode", "PolicyNode", "SafetyFilterNode", "parse_model", "settings_named", "hidden_robot"):
        monkeypatch.setattr(safety_pays, name, lambda *_: robot)
    monkeypatch.setattr(safety_pays, "drive", driven)
    monkeypatch.setattr(safety_pays.MarginCalibration, "parse", lambda *_: None)
    monkeypatch.setattr(safety_pays.Scene, "random", lambda *_: None)
    hidden = next(iter(safety_pays.HIDDEN))
    episode: Any = SimpleNamespace(
        hidden=hidden, name="oracle", model="", calibration="", seed=1, seconds=5 * safety_pays.PERIOD
    )
    found = safety_pays._run(episode)
    assert (found["collisions"], found["changed"], found["least_h"]) == (1, 0.4, -0.1)
    assert found["goals"] == int(reached_at is not None)
    assert found["first_goal"] == (None if reached_at is None else pytest.approx((reached_at + 1) * safety_pays.PERIOD))


def ros_drive(seed: int, **changes: Any) -> dict[str, Any]:
    usual = {"collisions": 0, "reached": 1, "moved": 10.0, "commands": 200, "gateway_brakes": 3, "driver_brakes": 4}
    return {"seed": seed, **usual, **changes}


def test_drives_by_ros() -> None:
    drives = [
        ros_drive(4), ros_drive(5, collisions=2, reached=0, moved=5.0), ros_drive(6, gateway_brakes=0, commands=100),
        ros_drive(7, collisions=1, driver_brakes=0),
    ]  # fmt: skip
    assert ros._row(drives, 30.0) == {
        "drives": 4, "drives_with_a_collision": 2, "share_95": wilson_interval(2, 4), "collisions": 3,
        "which": [5, 7], "goals": 3, "metres_a_minute": 17.5, "commands": 700, "periods_braked_by_the_gateway": 9,
        "periods_braked_by_the_driver": 12,
    }  # fmt: skip


def test_latencies_are_told_in_milliseconds_with_and_without_the_turn() -> None:
    """The chain's samples are microseconds."""
    told = ros._latency([(0.010, 0.004), (0.020, 0.008), (0.030, 0.012)], [250.0, 750.0])
    assert {name: (row["samples"], row["p50"]) for name, row in told.items()} == {
        "through_the_gateway": (3, 12.0), "waiting_for_its_turn": (3, 8.0), "both": (3, 20.0), "bare_chain": (2, 0.5),
    }  # fmt: skip
    for pairs, chain in (([], [1.0]), ([(0.1, 0.1)], [])):
        with pytest.raises(SafedpaError, match="got no command of the filter"):
            ros._latency(pairs, chain)


def sensed(seed: int, **changes: Any) -> dict[str, Any]:
    usual = {"load": "none", "moving": [], "run_into": 0, "standing": 0, "stepped_out": False, "goals": 2, "way": 30.0}
    return {"seed": seed, **usual, "kept": 0.5, "microseconds": 100.0, **changes}


def test_drives_among_people() -> None:
    drives = [
        sensed(1, moving=["a person", "a wall"], run_into=1, standing=2),
        sensed(2, standing=1, goals=0, way=0.0, stepped_out=True),
        sensed(3, moving=["a person"], run_into=1, stepped_out=True, kept=0.8, microseconds=900.0),
    ]  # fmt: skip
    told = [sensed(seed, goals=goals) for seed, goals in ((1, 2), (2, 1), (3, 3))]
    row = sensing.row_of(("crowd", "told"), drives, told, 30.0)
    assert row["goals_beside_perfect_knowledge"] == ratio_interval(np.array([2.0, 0.0, 2.0]), np.array([2.0, 1.0, 3.0]))
    del row["goals_beside_perfect_knowledge"]
    assert row == {
        "scene": "crowd", "guard": "told", "drives": 3, "drives_in_which_the_car_moved_into_something": 2,
        "share_95": clopper_pearson_interval(2, 3),
        "which": ["seed 1, load none: a person", "seed 1, load none: a wall", "seed 3, load none: a person"],
        "of_them_it_did_not_drive_towards": 2, "touched_while_it_stood": 3, "drives_in_which_somebody_stepped_out": 2,
        "goals_a_minute": pytest.approx(60.0 * 4 / 90.0), "share_of_the_wished_speed": pytest.approx(0.6),
        "metres_a_minute": pytest.approx(40.0), "median_microseconds": 100.0,
    }  # fmt: skip
    for nothing in ([], [sensed(1, goals=0)] * 3):
        assert sensing.row_of(("crowd", "told"), drives, nothing, 30.0)["goals_beside_perfect_knowledge"] is None


def test_goals_under_a_load_are_those_of_its_own_drives() -> None:
    drives = [sensed(1, goals=4), sensed(1, load="chair", goals=1), sensed(2, load="chair", goals=2)]
    told = sensing._of_load(("crowd", "told"), "chair", drives, 30.0)
    assert (told["drives"], told["goals_a_minute"]) == (2, 3.0)


def test_long_drives() -> None:
    def long(seed: int, **changes: Any) -> LongOutcome:
        usual: dict[str, Any] = {"seconds": 120.0, "collisions": 0, "goals": 2, "standstills": (), "longest_stand": 1.0}
        return LongOutcome("none", seed, **{**usual, "statuses": {}, "least_way": 5.0, **changes})

    stand: Any = {"begins": 3.0, "why": "a wall"}
    drives = [
        long(1), long(2, longest_stand=long_drives.LONG, standstills=(stand,)), long(3, longest_stand=99.0, goals=0),
        long(6, longest_stand=11.0, goals=4, least_way=0.9),
        long(4, collisions=2, least_way=0.5), long(5, collisions=1, seconds=60.0, least_way=1.0),
    ]  # fmt: skip
    assert long_drives.long_summary(drives) == {
        "drives": 6, "collisions": 3, "goals_a_minute": 1.17, "stands": 3, "crawls": 2, "untold": 2,
        "standstills": [{"load": "none", "seed": 2, "begins": 3.0, "why": "a wall"}],
    }  # fmt: skip
    assert long_drives.long_summary([])["goals_a_minute"] == 0


@pytest.mark.parametrize(
    ("steps", "least"),
    [
        ([1.0] * 20, 20.0),
        ([1.0] * 19, float("inf")),  # shorter than 20 s
        ([1.0] * 30 + [0.0] * 5 + [1.0] * 30, 15.0),
        ([1.0] * 10 + [0.0] * 25 + [1.0] * 10, 0.0),
        ([0.5] * 10 + [1.0] * 15 + [-1.0] * 30, 15.0),  # there and back is a way as well
    ],
)
@pytest.mark.parametrize("period", [1.0, 0.5])
def test_the_least_way_is_that_of_the_twenty_seconds_in_which_it_got_on_least(
    steps: list[float], least: float, period: float
) -> None:
    """Steps of a second each, m; told every second, or twice as often."""
    often = round(1.0 / period)
    along = np.cumsum([0.0, *np.repeat(np.array(steps) / often, often)])
    assert long_drives._least_way([(0.6 * x, -0.8 * x) for x in along], period) == pytest.approx(least)


@pytest.mark.parametrize(
    ("places", "longest"),
    [
        ([0.0, 0.1, 0.2, 0.3], 0.0),
        ([0.0, 0.0, 0.0, 0.0], 1.5),
        ([0.5, 1.0, 1.0, 1.015, 0.985, 1.0, 2.0, 2.0, 3.0], 2.0),  # from the second place on
        ([0.0, 0.01, 0.02, 0.03, 0.04, 0.05], 1.0),  # it creeps: more than 2 cm away it is another place
    ],
)
@pytest.mark.parametrize("way", [(1.0, 0.0), (0.0, -1.0), (-0.6, 0.8)])
def test_the_longest_stand_is_measured_within_two_centimetres_of_a_place(
    places: list[float], longest: float, way: tuple[float, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Told every half a second, for as many periods as the drive's seconds have."""
    robot = SimpleNamespace(values=(9.0, 9.0, 0.0, 0.0), collisions=[], goals_reached=0)

    def driven(_robot: Any, _nodes: Any, periods: int) -> Any:
        assert periods == len(places)
        for number, place in enumerate(places):
            values = (way[0] * place, way[1] * place, 0.0, 0.0)
            state = SimpleNamespace(robot_time=0.5 * number, values=values)
            yield SimpleNamespace(verdict=SimpleNamespace(status="passed", h_now=1.0), state=state)

    for name in ("AdaptationNode", "PolicyNode", "SafetyFilterNode", "settings_named", "margin_for", "_car"):
        monkeypatch.setattr(long_drives, name, lambda *_, **__: robot)
    monkeypatch.setattr(long_drives, "load_model", lambda _: SimpleNamespace(period=0.5))
    monkeypatch.setattr(long_drives, "note_standstill", lambda *_: None)
    monkeypatch.setattr(long_drives, "drive", driven)
    found = long_drives.run_long_drive(long_drives.LongDrive("none", 1, 0.5 * len(places)))
    assert found.longest_stand == pytest.approx(longest)


@pytest.mark.parametrize(
    ("changes", "in_time"),
    [
        ({}, (1, 1, 1, 1)),
        ({"raised": 109.99}, (1, 1, 1, 1)),
        ({"raised": 110.01}, (0, 1, 1, 1)),
        ({"raised": 99.0}, (0, 1, 1, 1)),  # before anything changed
        ({"raised": None}, (0, 1, 1, 1)),
        ({"found": 160.01}, (1, 1, 0, 1)),
        ({"found": None}, (1, 1, 0, 1)),
        ({"found": 99.0}, (1, 1, 0, 1)),  # named before anything changed
        ({"effect": "drag"}, (1, 0, 0, 1)),
        ({"effect": "drag", "group": ("towed_load",)}, (1, 0, 1, 1)),
        ({"fell": 190.01}, (1, 1, 1, 0)),
        ({"fell": None}, (1, 1, 1, 0)),
        ({"taken": None}, (1, 1, 1, 0)),
    ],
)
def test_what_changes_while_it_drives_is_found_in_time(changes: dict[str, Any], in_time: tuple[int, ...]) -> None:
    usual: dict[str, Any] = {"changed": 100.0, "raised": 105.0, "found": 150.0, "effect": "towed_load"}
    drive = LiveDrive("hitch", 1, **{**usual, "taken": 170.0, "fell": 180.0, "collisions": 2, **changes})
    row = live._row("hitch", [drive, drive])
    names = ("raised_in_time", "first", "named_in_time", "fell_in_time")
    assert tuple(row[name] for name in names) == tuple(2 * count for count in in_time)
    assert (row["drives"], row["collisions"]) == (2, 4)


def test_medians_are_those_of_what_happened_and_quiet_hours_are_counted() -> None:
    drives = [
        LiveDrive("none", 1, findings=1, evidence=3.5, collisions=1, driven=1800.0),
        LiveDrive("none", 2, findings=2, evidence=1.0, collisions=3, driven=5400.0),
    ]
    quiet = live._quiet(drives)
    assert (quiet["hours"], quiet["findings"], quiet["largest_evidence"], quiet["collisions"]) == (2.0, 3, 3.5, 4)
    assert quiet["stated_probability_at_most"] == pytest.approx(live.ALPHA * 7200.0)
    assert live._median([None, 3.0, 1.0, None, 8.0]) == 3.0
    assert live._median([None]) is None


def test_errors_of_a_model_by_state_and_over_all() -> None:
    errors, scale = np.array([[3.0, 0.0, 2.0, 1.0], [-3.0, 8.0, 0.0, 1.0]]), np.array([1.0, 2.0, 1.0, 0.5])
    told = car_errors._summary(errors, scale)
    root = [3.0, np.sqrt(32.0), np.sqrt(2.0), 1.0]
    assert list(told["root_mean_square"].values()) == pytest.approx(root)
    assert list(told["per_state"].values()) == pytest.approx([3.0, np.sqrt(8.0), np.sqrt(2.0), 2.0])
    assert told["number"] == pytest.approx(np.mean([3.0, np.sqrt(8.0), np.sqrt(2.0), 2.0]))
    assert (told["count"], told["position"]) == (2, pytest.approx(np.sqrt(9.0 + 32.0)))


@pytest.mark.parametrize(
    ("fine", "first"),
    [
        ("1111111111", 0), ("0111111111", None), ("01111111111", 1), ("1101110111", 0), ("1101110110", None),
        ("10000000001111111111", 10), ("111111111", None), ("", None),
    ],
)  # fmt: skip
def test_a_change_is_noticed_at_the_first_tick_that_lasts_but_for_two_of_ten(fine: str, first: int | None) -> None:
    assert car_latent._first_lasting(np.array([letter == "1" for letter in fine], dtype=bool)) == first


def test_how_soon_a_load_is_noticed() -> None:
    within = float(car_latent.WITHIN)
    values = [(10, None), (int(within), None), (int(within) + 1, 4), (None, 6)]
    changes = [{"latent_ticks": latent, "error_ticks": error} for latent, error in values]
    told = car_latent._adaptation(changes)
    assert (told["latent_ticks"]["within"], told["latent_ticks"]["of"]) == (2, 4)
    assert told["latent_ticks"]["median"] == pytest.approx(within + 0.5)
    assert (told["error_ticks"]["within"], told["error_ticks"]["median"]) == (2, None)
    assert told["error_ticks"]["interval_95"] == list(wilson_interval(2, 4))
    assert car_latent._adaptation([])["latent_ticks"]["of"] == 0


def test_the_plane_of_most_variance_and_its_shares() -> None:
    """Variances of 9, 4 and 1 along the axes: 9/14 and 4/14."""
    points = np.concatenate(
        [size * np.array([unit, -unit]) for size, unit in zip((3.0, 2.0, 1.0), np.eye(3), strict=True)]
    )
    middle, directions, shares = car_latent.principal_plane(points + 5.0)
    assert middle == pytest.approx([5.0] * 3)
    assert np.abs(directions) == pytest.approx(np.eye(3)[:2])
    assert shares == pytest.approx([9.0 / 14.0, 4.0 / 14.0])
    assert car_latent._accuracy(["a", "b", "b"], ["a", "b", "a"]) == {
        "right": 2,
        "of": 3,
        "share": pytest.approx(2 / 3),
    }


@pytest.mark.parametrize("share_of", [car_table._share, hidden_summary._share, fleet_diagnosis._share])
@pytest.mark.parametrize("hits", [[True, False, True, True], [False], [True] * 5])
def test_a_share_has_its_hits_its_trials_and_its_interval(share_of: Any, hits: list[bool]) -> None:
    told = share_of(hits)
    assert told["hits"] == sum(hits)
    assert told.get("of", told.get("cases", len(hits))) == len(hits)
    assert told["interval_95"] == [round(end, 4) for end in wilson_interval(sum(hits), len(hits))]


def test_diagnoses_at_several_horizons_are_equal_where_verdict_and_names_are(monkeypatch: pytest.MonkeyPatch) -> None:
    verdicts = iter(["model", "model", "model", "effect", "effect", "effect"])
    monkeypatch.setattr(
        hidden_horizons, "cases_of", lambda *_: [SimpleNamespace(name=name, effects={}) for name in "abc"]
    )
    monkeypatch.setattr(hidden_horizons, "write_case", lambda *_: None)
    monkeypatch.setattr(hidden_horizons, "_said", lambda _, horizon: {"verdict": next(verdicts), "added": []})
    told: list[tuple[int, int]] = []
    document = hidden_horizons.hidden_horizons(["one"], 3, horizons=(0.2, 1.0), tell=lambda *done: told.append(done))
    assert (document["equal"], document["of"]) == (2, 3)
    assert [row["equal"] for row in document["cases"]] == [True, False, True]
    assert told == [(1, 3), (2, 3), (3, 3)]
