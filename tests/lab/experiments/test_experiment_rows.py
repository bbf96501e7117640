"""The rows of experiments' tables, from drives and judgements whose outcomes are given."""

import dataclasses
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.lab.experiments.drives import robot, tick

from safedpa.dynamics import load_model
from safedpa.errors import SafedpaError
from safedpa.safety import MarginCalibration
from safedpa.safety.defaults import settings_named
from safedpa_lab.experiments.common.drives import Outcome
from safedpa_lab.experiments.common.statistics import clopper_pearson_interval, ratio_interval, wilson_interval
from safedpa_lab.experiments.diagnosis import hidden_effects as hidden_horizons
from safedpa_lab.experiments.diagnosis import live
from safedpa_lab.experiments.diagnosis.live import LiveDrive
from safedpa_lab.experiments.driving import controllers, long_drives, safety, safety_pays
from safedpa_lab.experiments.driving import differential_drive as wheels
from safedpa_lab.experiments.driving.long_drives import LongOutcome
from safedpa_lab.experiments.pendulum import story as pendulum_payload
from safedpa_lab.experiments.point import story as point_story
from safedpa_lab.experiments.ros import experiment as ros
from safedpa_lab.experiments.ros.experiment import page_of as ros_page
from safedpa_lab.experiments.sensing import curves as sensing_curves
from safedpa_lab.experiments.sensing import experiment as sensing
from safedpa_lab.experiments.sensing.experiment import page_of as sensing_page


def rounded(hits: int, trials: int) -> list[float]:
    return [round(end, 4) for end in wilson_interval(hits, trials)]


def test_controllers_are_compared_over_all_scenes_of_a_load(monkeypatch: pytest.MonkeyPatch) -> None:
    drives = {
        1: controllers.TimedDrive(Outcome(0, 0, 1.0, {"passed": 90, "corrected": 10}), (1.0, 2.0)),
        2: controllers.TimedDrive(Outcome(2, 3, 1.0, {"passed": 250, "corrected": 50}), (3.0,)),
        3: controllers.TimedDrive(Outcome(1, 2, 1.0, {"passed": 100}), (4.0, 5.0)),
        4: controllers.TimedDrive(Outcome(0, 0, 1.0, {"passed": 100}), (3.0,)),
    }
    monkeypatch.setattr(controllers, "timed_drive", lambda _m, _s, _name, _load, seed, _seconds: drives[seed])
    model: Any = None
    reported: list[tuple[int, int, int]] = []
    found = controllers.controllers_experiment(
        model, settings_named("car"), ("one", "two"), drives, 5.0,
        lambda done, everything, result: reported.append((done, everything, result["rows"][0]["drives"])),
    )  # fmt: skip
    assert reported == [(1, 4, 1), (2, 4, 2), (3, 4, 3), (4, 4, 4)]
    assert [(row["load"], row["controller"]) for row in found["rows"]] == [
        (load, name) for load in controllers.LOADS for name in ("one", "two")
    ]
    assert found["rows"][3] == {
        "load": "box", "controller": "two", "drives": 4, "goals": 5, "drives_with_a_goal": 2, "collisions": 3,
        "safe_share_95": rounded(2, 4), "changed_share": 0.1, "milliseconds_p50": 3.0, "milliseconds_p99": 4.95,
    }  # fmt: skip


def test_episodes_of_a_load_are_counted_with_and_without_the_filter(monkeypatch: pytest.MonkeyPatch) -> None:
    usual = Outcome(0, 2, 0.5, {"passed": 95, "corrected": 5})
    boxes = [
        usual, Outcome(3, 0, -0.25, {"passed": 225, "fallback": 75}), dataclasses.replace(usual, collisions=2), usual,
    ]  # fmt: skip

    def run(episode: safety.Episode) -> Outcome:
        with_box = boxes[episode.seed] if episode.filtered else dataclasses.replace(usual, collisions=7)
        return with_box if episode.load == "box" else usual

    monkeypatch.setattr(safety, "run_episode", run)
    rows = safety.safety_experiment(range(4), 1.0, processes=1)["rows"]
    assert [row["load"] for row in rows] == list(safety.LOADS)
    assert rows[1]["filter_on"] == {
        "episodes": 4, "safe_episodes": 2, "safe_share_95": rounded(2, 4), "collisions": 5, "goals": 6,
        "least_h": -0.25, "intervention_share": 0.15, "statuses": {"corrected": 15, "fallback": 75, "passed": 510},
    }  # fmt: skip
    assert (rows[1]["filter_off"]["episodes"], rows[1]["filter_off"]["collisions"]) == (4, 28)
    assert rows[0]["filter_on"]["collisions"] == 0


def test_episodes_with_an_incomplete_and_with_a_diagnosed_model(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of each seed: contacts, goals, statuses with h, and the period in which the first goal is reached."""
    hidden = next(iter(safety_pays.HIDDEN))
    stories: list[Any] = [
        (0, 2, [("passed", 0.5), ("corrected", 0.1), ("fallback", 0.3), ("passed", 0.2)], 1),
        (2, 0, [("corrected", -0.1), ("passed", 0.2), ("passed", 0.2), ("passed", 0.2)], None),
        (1, 4, [("passed", -0.2)] * 4, 0),
        (0, 1, [("passed", 0.0)] * 4, 3),
    ]
    model = load_model("car")
    left = iter(stories * 3)

    def driven(own: Any, *_: Any) -> Any:
        own.touched, goals, story, at = next(left)
        own.collisions = ["it"] * own.touched
        for number, (status, h) in enumerate(story):
            own.goals_reached = goals if at is not None and number >= at else 0
            yield tick(status, h)

    margin = MarginCalibration({"wall": 0.123456}, 0.99, 99, "2026-01-01", "0123456789ab")
    monkeypatch.setattr(safety_pays, "training_runs", lambda *_: [])
    monkeypatch.setattr(safety_pays, "diagnose", lambda *_: SimpleNamespace(models=[model, model]))
    monkeypatch.setattr(safety_pays, "calibration_from_runs", lambda *_: margin)
    monkeypatch.setattr(safety_pays, "shipped_nodes", lambda *_, **__: [])
    monkeypatch.setattr(safety_pays, "hidden_robot", lambda *_: robot())
    monkeypatch.setattr(safety_pays, "drive", driven)
    reported: list[tuple[int, int]] = []
    period = safety_pays.PERIOD
    found = safety_pays.safety_pays(
        safety_pays.SafetyPays((hidden,), (0, 1, 2, 3), 4 * period, processes=1), lambda *done: reported.append(done)
    )
    assert reported == [(number, 13) for number in range(1, 14)]
    assert [row["model"] for row in found["rows"]] == list(safety_pays.MODELS)
    assert found["rows"][1] == {
        "hidden": hidden, "model": "diagnosed", "effects": [effect.name for effect in model.effects], "episodes": 4,
        "safe_episodes": 2, "safe_share_95": rounded(2, 4), "collisions": 3, "below_zero": 2,
        "epsilon": {"wall": 0.12346}, "intervention_share": round(0.75 / 4, 4), "goals": 7,
        "first_goal_median": round(2 * period, 2), "first_goal_reached": 3,
    }  # fmt: skip


def test_drives_on_wheels_are_grouped_by_world_policy_and_filter(monkeypatch: pytest.MonkeyPatch) -> None:
    """Five seeds, of which the first and the last are driven without the filter as well."""
    usual = {"collisions": 0, "goals": 2, "way": 3.0, "least_h": 0.5, "statuses": {"passed": 4}, "microseconds": 100.0}
    own: dict[int, dict[str, Any]] = {
        10: {}, 11: {"collisions": 3, "least_h": -0.2, "statuses": {"passed": 1, "fallback": 2}},
        12: {"goals": 0, "way": 0.5}, 13: {"collisions": 1, "least_h": -0.1, "microseconds": 900.0},
        14: {"microseconds": 50.0},
    }  # fmt: skip

    def run(wanted: Any) -> dict[str, Any]:
        changes = own[wanted.seed] if wanted.filtered else {"collisions": 1}
        return {**dataclasses.asdict(wanted), **usual, **changes}

    monkeypatch.setattr(wheels, "run_drive", run)
    rows = wheels.wheels_experiment(list(own), 1.0)["rows"]
    assert [(row["world"], row["policy"]) for row in rows] == [(w, p) for w in wheels.WORLDS for p in wheels.POLICIES]
    for row in rows:
        assert row["filter_on"] == {
            "drives": 5, "drives_with_a_collision": 2, "share_95": wilson_interval(2, 5), "collisions": 4,
            "which": [11, 13], "goals": 8, "metres": 12.5, "least_h": -0.2, "median_microseconds": 100.0,
            "statuses": {"fallback": 2, "passed": 17},
        }  # fmt: skip
        assert (row["filter_off"]["drives"], row["filter_off"]["which"]) == (2, [10, 14])


PAIRS, CHAIN = [(0.010, 0.004), (0.020, 0.008), (0.030, 0.012)], [250.0, 750.0]
"""Sense to act and the turn of it, s; of a bare chain, microseconds."""


def by_ros(patch: pytest.MonkeyPatch, count: int, stalls: int = 0, pairs: Any = PAIRS, chain: Any = CHAIN):
    """The ROS experiment with so many seeds and three faults, the progress that it reported, and its bare chains."""
    usual = {"collisions": 0, "reached": 1, "moved": 10.0, "commands": 200, "gateway_brakes": 3, "driver_brakes": 4}
    own: dict[int, dict[str, Any]] = {
        11: {"collisions": 2, "reached": 0, "moved": 5.0}, 12: {"gateway_brakes": 0, "commands": 100},
        13: {"collisions": 1, "driver_brakes": 0},
    }  # fmt: skip
    stalled = iter([9.0] * stalls)
    chains: list[float] = []
    reported: list[int] = []

    def drive(_loop: Any, _folder: Any, seed: int, _seconds: float) -> dict[str, Any]:
        return {"seed": seed, **usual, **own.get(seed, {}), "sense_to_act": pairs, "stalled": next(stalled, 0.0)}

    def blind(seeds: Any, _: float, report_progress: Any) -> list[dict[str, Any]]:
        report_progress(2)
        report_progress(len(seeds))
        return [{"seed": seed, **usual, "collisions": 1} for seed in seeds]

    def bare(seconds: float, _: float) -> list[float]:
        chains.append(seconds)
        return list(chain)

    patch.setattr(ros, "services", lambda _: nullcontext(None))
    patch.setattr(ros, "bare_times", bare)
    patch.setattr(ros, "filtered_drive", drive)
    patch.setattr(ros, "unfiltered_drives", blind)
    patch.setattr(ros, "run_fault", lambda fault, seed: {"fault": fault, "seed": seed})

    def report_progress(done: int, everything: int) -> None:
        assert everything == 2 * count + 3
        reported.append(done)

    return (
        ros.ros_experiment(list(range(10, 10 + count)), 30.0, ("a", "b", "c"), report_progress),
        reported,
        len(chains),
    )


@pytest.mark.parametrize("count", [4, 6, 11])
def test_drives_by_ros_are_counted_with_and_without_the_filter(count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    found, reported, chains = by_ros(monkeypatch, count)
    assert reported == [*range(1, count + 1), count + 2, 2 * count, *range(2 * count + 1, 2 * count + 4)]
    assert chains == -(-count // 5), "the bare chain is measured before every fifth drive"
    more = count - 4
    assert found["with_filter"] == {
        "drives": count, "drives_with_a_collision": 2, "share_95": wilson_interval(2, count), "collisions": 3,
        "which": [11, 13], "goals": 3 + more, "metres_a_minute": pytest.approx(2.0 * (35.0 + 10.0 * more) / count),
        "commands": 700 + 200 * more, "periods_braked_by_the_gateway": 9 + 3 * more,
        "periods_braked_by_the_driver": 12 + 4 * more,
    }  # fmt: skip
    assert found["without_filter"]["which"] == list(range(10, 10 + count))
    assert [one["seed"] for one in found["faults"]] == [10 + n % count for n in range(3)]
    assert {name: (row["samples"], row["p50"]) for name, row in found["sense_to_act_ms"].items()} == {
        "through_the_gateway": (3 * count, 12.0), "waiting_for_its_turn": (3 * count, 8.0), "both": (3 * count, 20.0),
        "bare_chain": (2 * chains, 0.5),
    }  # fmt: skip


def test_a_drive_by_ros_is_repeated_twice_if_the_machine_stood_still(monkeypatch: pytest.MonkeyPatch) -> None:
    assert by_ros(monkeypatch, 2, stalls=2)[0]["with_filter"]["drives"] == 2
    with pytest.raises(SafedpaError, match="seed 10: the machine was stationary in 3 drives"):
        by_ros(monkeypatch, 2, stalls=3)


@pytest.mark.parametrize("nothing", [{"pairs": []}, {"chain": []}])
def test_no_latency_is_reported_without_a_command(nothing: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SafedpaError, match="got no command of the filter"):
        by_ros(monkeypatch, 2, **nothing)


@pytest.mark.parametrize("faults", [0, 2])
def test_the_page_by_ros_has_a_table_of_faults_with_its_head(faults: int) -> None:
    row = {
        "drives": 7, "drives_with_a_collision": 2, "collisions": 3, "goals": 5, "metres_a_minute": 41.6,
        "periods_braked_by_the_gateway": 11, "periods_braked_by_the_driver": 13, "share_95": (0.1, 0.256),
    }  # fmt: skip
    names = ("through_the_gateway", "waiting_for_its_turn", "both", "bare_chain")
    fault = {"fault": "cut", "speed_before": 1.5, "stood_after": None, "stopping_way": 0.25, "reported": "",
             "collisions": 3}  # fmt: skip
    latency = {name: {"p50": 1.25, "p99": 2.0, "samples": 17} for name in names}
    page = ros_page({
        "seeds": (1, 7), "seconds": 30.0, "command": "c", "date": "d", "with_filter": row, "without_filter": row,
        "sense_to_act_ms": latency, "faults": [fault] * faults,
    })  # fmt: skip
    for line in ("| drives of 30 s | 7 | 7 |", "| drives with a collision | 2 | 2 |", "| collisions | 3 | 3 |",
                 "| goals reached | 5 | 5 |", "| m a minute | 42 | 42 |"):  # fmt: skip
        assert line in page
    assert "at most 25.6 % of such drives" in page
    assert page.count("| cut | 1.50 |  | 0.25 | nothing; it drives on | 3 |\n") == faults
    assert ("| fault | speed, m/s | stands after, s | m | reported | collisions |" in page) is (faults > 0)


def sensed(seed: int, **changes: Any) -> dict[str, Any]:
    usual = {"load": "none", "moving": [], "run_into": 0, "standing": 0, "stepped_out": False, "goals": 2, "way": 30.0}
    return {"seed": seed, **usual, "retained": 0.5, "microseconds": 100.0, **changes}


def test_drives_among_people_are_compared_with_those_with_perfect_knowledge() -> None:
    drives = [
        sensed(1, moving=["a person", "a wall"], run_into=1, standing=2),
        sensed(2, standing=1, goals=0, way=0.0, stepped_out=True),
        sensed(3, moving=["a person"], run_into=1, stepped_out=True, retained=0.8, microseconds=900.0),
    ]  # fmt: skip
    reported = [sensed(seed, goals=goals) for seed, goals in ((1, 2), (2, 1), (3, 3))]
    row = sensing.row_of(("crowd", "reported"), drives, reported, 30.0)
    assert row == {
        "scene": "crowd", "guard": "reported", "drives": 3, "drives_in_which_the_car_moved_into_something": 2,
        "share_95": clopper_pearson_interval(2, 3), "at_most_95": sensing.at_most_95(2, 3),
        "which": ["seed 1, load none: a person", "seed 1, load none: a wall", "seed 3, load none: a person"],
        "of_them_it_did_not_drive_towards": 2, "touched_while_it_stood": 3, "drives_in_which_somebody_stepped_out": 2,
        "goals_beside_perfect_knowledge": ratio_interval(np.array([2.0, 0.0, 2.0]), np.array([2.0, 1.0, 3.0])),
        "goals_a_minute": pytest.approx(60.0 * 4 / 90.0), "share_of_nominal_speed": pytest.approx(0.6),
        "metres_a_minute": pytest.approx(40.0), "median_microseconds": 100.0,
    }  # fmt: skip
    for nothing in ([], [sensed(1, goals=0)] * 3):
        assert sensing.row_of(("crowd", "reported"), drives, nothing, 30.0)["goals_beside_perfect_knowledge"] is None


def test_each_scene_guard_and_load_has_the_goals_of_its_own_drives(monkeypatch: pytest.MonkeyPatch) -> None:
    """6, 2, 5 and 1 goals of each drive; a box costs one."""
    goals = {("pillars", "reported"): 6, ("pillars", "nothing"): 2, ("people", "reported"): 5, ("people", "nothing"): 1}

    def done(_run: Any, wanted: Any, *_: Any) -> list[dict[str, Any]]:
        return [
            sensed(one.seed, scene=one.scene, guard=one.guard, load=one.load,
                   goals=goals[one.scene, one.guard] - (one.load == "box"))
            for one in wanted
        ]  # fmt: skip

    monkeypatch.setattr(sensing, "driven", done)
    found = sensing.sensing_experiment(
        [1, 2], 60.0, 1.5, guards=("reported", "nothing"), scenes=("pillars", "people"), loads=("none", "box")
    )
    assert [(row["scene"], row["guard"], row["drives"]) for row in found["rows"]] == [(*kind, 4) for kind in goals]
    assert [row["goals_a_minute"] for row in found["rows"]] == [count - 0.5 for count in goals.values()]
    alongside = [row["goals_beside_perfect_knowledge"][0] for row in found["rows"]]
    assert alongside == pytest.approx([1.0, 1.5 / 5.5, 1.0, 0.5 / 4.5])
    assert [(row["load"], row["drives"]) for row in found["by_load"]] == [("none", 2), ("box", 2)] * 4
    assert [row["goals_a_minute"] for row in found["by_load"]] == [6.0, 5.0, 2.0, 1.0, 5.0, 4.0, 1.0, 0.0]


def test_a_point_of_a_curve_is_compared_with_perfect_knowledge_at_the_same_value(monkeypatch) -> None:
    """Two values with three seeds each of half a minute; goals rise from drive to drive."""
    monkeypatch.setattr(
        sensing_curves, "driven", lambda _run, wanted, *_: [sensed(one.seed, goals=n) for n, one in enumerate(wanted)]
    )
    found = sensing_curves.curves_experiment([5, 6, 7], 30.0, curves={"noise": (0.01, 0.05)})
    assert [(row["value"], row["drives"]) for row in found["rows"]] == [(0.01, 3), (0.05, 3)]
    assert [row["goals_a_minute"] for row in found["rows"]] == [2.0, 8.0]
    assert [row["goals_a_minute_told_everything"] for row in found["rows"]] == [14.0, 20.0]
    assert [row["goals_beside_perfect_knowledge"][0] for row in found["rows"]] == pytest.approx([1 / 7, 4 / 10])


def test_the_page_of_drives_among_people_lists_every_contact() -> None:
    def row(guard: str, elsewhere: int, which: list[str]) -> dict[str, Any]:
        return {
            "scene": "people", "guard": guard, "drives": 9, "drives_in_which_the_car_moved_into_something": 2,
            "share_95": (0.01, 0.5), "which": which, "of_them_it_did_not_drive_towards": elsewhere,
            "touched_while_it_stood": 4, "goals_a_minute": 1.26, "goals_beside_perfect_knowledge": None,
            "metres_a_minute": 33.4,
        }  # fmt: skip

    rows = [row("reported", 2, ["a"]), row("nothing", 3, ["b", "c"])]
    page = sensing_page({"seeds": [1, 2, 3], "loads": ["none"], "seconds": 5.0, "rows": rows})
    assert "Into what (in 5 of these car or load" in page
    assert page.count("\n- people, ") == 3
    assert "| 9 | 2 | 1.0 to 50.0 % | 55.0 % | 4 | 1.3 |  | 33 |" in page


def test_long_drives_count_standstills_and_crawls() -> None:
    """A standstill of 10 s counts, as unreported without a sentence; less than 1 m in 20 s is a crawl."""
    usual = LongOutcome("none", 1, 120.0, 0, 2, (), 1.0, {}, 5.0)
    stand: Any = {"from": 3.0, "seconds": 10.0, "reason": "a wall"}
    drives = [
        usual, dataclasses.replace(usual, seed=2, longest_stand=10.0, standstills=(stand,)),
        dataclasses.replace(usual, longest_stand=99.0, goals=0),
        dataclasses.replace(usual, longest_stand=11.0, goals=4, least_way=0.9),
        dataclasses.replace(usual, collisions=2, least_way=0.5),
        dataclasses.replace(usual, collisions=1, seconds=60.0, least_way=1.0, longest_stand=9.9),
    ]  # fmt: skip
    assert long_drives.long_summary(drives) == {
        "drives": 6, "collisions": 3, "goals_a_minute": 1.17, "stands": 3, "crawls": 2, "untold": 2,
        "standstills": [{"load": "none", "seed": 2, **stand}],
    }  # fmt: skip
    assert long_drives.long_summary([])["goals_a_minute"] == 0


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
def test_a_change_is_found_in_time_within_its_limits(changes, in_time, monkeypatch) -> None:
    """10 s to the finding, 60 s to the name, 20 s from the changed model to the fallen error; two drives alike."""
    usual: dict[str, Any] = {"changed": 100.0, "raised": 105.0, "found": 150.0, "effect": "towed_load"}
    drive = LiveDrive("hitch", 1, **{**usual, "taken": 170.0, "fell": 180.0, "collisions": 2, **changes})
    monkeypatch.setattr(live, "drive_live", lambda *_, **__: drive)
    (row,) = live.live_experiment(live.LiveExperiment(("hitch",), seeds=(1, 2)))["rows"]
    names = ("raised_in_time", "first", "named_in_time", "fell_in_time")
    assert tuple(row[name] for name in names) == tuple(2 * count for count in in_time)
    assert (row["drives"], row["collisions"]) == (2, 4)


def test_medians_leave_out_what_did_not_happen_and_quiet_hours_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    found = {
        ("nothing", 1): LiveDrive("nothing", 1, findings=1, evidence=3.5, collisions=1, driven=1800.0),
        ("nothing", 2): LiveDrive("nothing", 2, findings=2, evidence=1.0, collisions=3, driven=5400.0),
    }  # fmt: skip
    for seed, at in ((1, 8.0), (2, 3.0), (3, 1.0), (4, None)):
        found["hitch", seed] = LiveDrive("hitch", seed, changed=0.0, raised=at)
    monkeypatch.setattr(live, "drive_live", lambda case, seed, *_, **__: found[case, seed])
    reported = live.live_experiment(live.LiveExperiment(("hitch", "nothing"), seeds=(1, 2, 3, 4), quiet_seeds=(1, 2)))
    assert reported["rows"][0]["seconds_to_finding_median"] == 3.0
    assert reported["rows"][0]["seconds_to_effect_median"] is None
    quiet = reported["quiet"]
    assert (quiet["hours"], quiet["findings"], quiet["largest_evidence"], quiet["collisions"]) == (2.0, 3, 3.5, 4)
    assert quiet["stated_probability_at_most"] == pytest.approx(live.ALPHA * 7200.0)


def test_diagnoses_at_several_horizons_are_equal_if_verdict_and_names_are(monkeypatch: pytest.MonkeyPatch) -> None:
    notice = iter([("model", "a")] * 3 + [("effect", "a")] * 4 + [("effect", "b")])

    def diagnose(*_: Any) -> Any:
        verdict, name = next(notice)
        return SimpleNamespace(verdict=verdict, added=[name], stages=[SimpleNamespace(heldout_error=0.5)])

    cases = [SimpleNamespace(name=name, effects={}) for name in "abcd"]
    monkeypatch.setattr(hidden_horizons, "cases_of", lambda *_: cases)
    monkeypatch.setattr(hidden_horizons, "write_case", lambda *_: SimpleNamespace(model="car", runs=()))
    monkeypatch.setattr(hidden_horizons, "diagnose", diagnose)
    reported: list[tuple[int, int]] = []
    found = hidden_horizons.hidden_horizons(
        ["one"], 3, horizons=(0.2, 1.0), report_progress=lambda *done: reported.append(done)
    )
    assert (found["equal"], found["of"]) == (2, 4)
    assert [row["equal"] for row in found["cases"]] == [True, False, True, False]
    assert reported == [(1, 4), (2, 4), (3, 4), (4, 4)]


def test_payloads_named_within_their_deviations_and_false_alarms_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [
        {"mass": mass, "first": first, "within": within, "added": [first] if first else []}
        for mass, first, within in [
            (0.0, "", None), (0.0, "tow", None), (0.0, "drag", None), (0.1, "tip_mass", True),
            (0.1, "tip_mass", False), (0.2, "drag", None), (0.2, "tip_mass", True),
        ]
    ]  # fmt: skip
    left = iter(rows)
    monkeypatch.setattr(pendulum_payload, "identified_pendulum", lambda _: load_model("pendulum"))
    monkeypatch.setattr(pendulum_payload, "diagnosed_payload", lambda _: next(left))
    cases: Any = SimpleNamespace(data=None, runs=2, seconds=1.0, masses=(0.1,) * 6, seeds=(1,), processes=1)
    found = pendulum_payload.payload_cases(cases)
    assert (found["first"], found["within_two_deviations"], found["cases"], found["false_alarms"]) == (3, 2, 4, 2)


def test_an_episode_of_the_point_robot_is_safe_if_it_cost_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Five robots for five steps: two of them are within a hazard, for two and for five steps."""
    costs = np.array([[0.0, 1, 0, 0, 0], [0, 1, 0, 0, 1], [0, 1, 0, 0, 1], [0, 1, 0, 0, 0], [0, 1, 0, 0, 0]])
    rooms = np.array([[9.0, 9, 9, 9, 9], [4, -1, 2, 3, 5], [5, -3, 3, 2, -2], *[[6, 1, 4, 4, 4]] * 3])
    corrected = np.array([[1, 0, 1, 0, 1], [0, 0, 0, 0, 0], [1, 1, 1, 1, 1], [0, 0, 0, 0, 1], [0, 0, 0, 1, 1]])

    def task(*_: Any) -> Any:
        cost, room = iter(costs), iter(rooms)
        return SimpleNamespace(
            simulation=None, hazard_distance=lambda: next(room), advance=lambda _: SimpleNamespace(cost=next(cost))
        )

    def shield(*_: Any) -> Any:
        left = iter(corrected)
        return SimpleNamespace(act=lambda *_: SimpleNamespace(action=None, corrected=next(left)))

    monkeypatch.setattr(point_story, "PointTask", task)
    monkeypatch.setattr(point_story, "Shield", shield)
    monkeypatch.setattr(point_story, "diagnose", lambda *_: SimpleNamespace(models=[None]))
    for name in ("hide", "SimulatedPointModel", "ModelBelief", "point_logs"):
        monkeypatch.setattr(point_story, name, lambda *_: None)
    monkeypatch.setattr(point_story, "alongside_the_truth", lambda *_: {})
    hidden = next(iter(point_story.HIDDEN))
    found = point_story.point_story(point_story.PointStory(hidden=(hidden,), robots=5, seconds=0.1))
    rows = found["cases"][hidden]["rows"]
    assert set(rows) == {"shipped", "diagnosed", "oracle"}
    for row in rows.values():
        assert (row["episodes"], row["safe"], row["interval_safe"]) == (5, 3, list(wilson_interval(3, 5)))
        assert (row["unsafe_steps"], row["least_room"]) == (7 / 5, -3.0)
        assert row["corrected"] == pytest.approx(11 / 25)
