"""The car made harder: what a condition changes, what a sweep asks for, and the command from end to end."""

import json
from dataclasses import replace
from itertools import pairwise
from math import hypot
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from safedpa.bus import LATENT, NOMINAL
from safedpa.dynamics import load_model
from safedpa.errors import InputError
from safedpa.policy import PolicyNode
from safedpa.safety.defaults import settings_named
from safedpa_lab.experiments.car.conditions import (
    CONFIGURATIONS,
    HEAVIER,
    PASSAGE,
    TOWING,
    Conditions,
    car_scene,
    towed_named,
)
from safedpa_lab.experiments.car.curves import LOAD, SWEEPS, Place, chosen_sweeps
from safedpa_lab.experiments.car.episodes import Cell, Outcome, run_group
from safedpa_lab.experiments.car.methods import METHODS
from safedpa_lab.experiments.car.report import advantages
from safedpa_lab.experiments.common.figures import METHOD_COLOURS
from safedpa_services.command_line.group import safedpa

SETTINGS = settings_named("car")
NOWHERE = Path("/nowhere")


def outcomes(conditions: Conditions, ticks: int = 40, seeds: tuple[int, ...] = (3000,), load: str = LOAD):
    """Of the physics model behind its filter, with the settings' margin."""
    return run_group(Cell(METHODS["physics"], load, seeds, NOWHERE, SETTINGS, None, conditions, ticks))


@pytest.mark.parametrize("sweep", SWEEPS.values(), ids=lambda sweep: sweep.name)
def test_a_sweep_holds_the_experiment_s_own_value_and_every_other_one_is_another_place(sweep: Any) -> None:
    usual = [value for value in sweep.values if sweep.at(value) == Place(LOAD, Conditions())]
    assert usual == ([] if sweep.name == "row" else [sweep.usual])
    assert len({sweep.at(value) for value in sweep.values}) == len(sweep.values)
    assert len(set(sweep.shown)) == len(sweep.values)


def test_the_loads_of_the_sweep_are_named_by_their_mass() -> None:
    sweep = SWEEPS["load"]
    for value in sweep.values:
        load = towed_named(sweep.at(value).load)
        assert (0.0 if load is None else load.mass_ratio) == value
    assert max(sweep.values) == 2.0
    assert not HEAVIER.keys() & CONFIGURATIONS.keys()


def test_without_conditions_an_episode_and_its_cell_are_the_experiment_s_own() -> None:
    """What was measured before conditions were known is still found: the key says nothing of them."""
    cell = Cell(METHODS["physics"], LOAD, (0,), NOWHERE, SETTINGS, None)
    harder = replace(cell, conditions=Conditions(friction=0.6))
    assert (cell.name, harder.name) == ("physics-chair", "physics-chair-friction=0.6")
    assert cell.key == replace(cell, conditions=Conditions(friction=1.0)).key != harder.key
    assert [group.conditions for group in harder.groups((0, 1))] == [harder.conditions]
    assert Conditions(delay=0.1, reported=False).label == "delay=0.1,reported=False"


@pytest.mark.parametrize("passage", SWEEPS["passage"].values)
def test_narrower_passages_are_left_and_something_always_fits(passage: float) -> None:
    narrowest = []
    for seed in range(3000, 3020):
        scene = car_scene(seed, LOAD, passage)
        spaces = [
            hypot(x - a, y - b) - size - other - 2 * scene.footprint[2]
            for index, (x, y, size) in enumerate(scene.obstacles)
            for a, b, other in scene.obstacles[:index]
        ]
        narrowest.append(min(spaces))
    assert min(narrowest) >= passage
    assert np.median(narrowest) < passage + 0.15, "a passage that is nowhere near so narrow makes nothing harder"


@pytest.mark.parametrize("load", ["chair", "two_cars"])
def test_a_row_leaves_passages_of_just_that_width_and_no_way_around(load: str) -> None:
    for seed in range(3000, 3020):
        scene = car_scene(seed, load, 0.2, row=True)
        row = sorted(scene.obstacles)
        assert len({y for _, y, _ in row}) == 1
        for (x, _, size), (a, _, other) in pairwise(row):
            assert a - x - size - other == pytest.approx(2 * scene.footprint[2] + 0.2)
        assert row[0][0] - row[0][2] <= -4.0
        assert row[-1][0] + row[-1][2] >= 4.0
        y, radius = row[0][1], scene.footprint[2]
        for x, far in ((0.0, 2.0), scene.start[:2]):
            assert all(hypot(a - x, b - far) > size + radius for a, b, size in row)
        way = scene.start[0] * (1.0 - (y + 2.0) / 4.0)
        assert min(abs(x - way) - size for x, _, size in row) <= radius


def test_grip_and_speed_are_the_robot_s_and_the_filter_knows_the_speed() -> None:
    conditions = Conditions(friction=0.5, speed=1.5)
    robot = conditions.robot(3000, LOAD)
    assert robot.world.parameters.friction == 0.45
    assert robot.guard.high == (3.0, 0.34)
    settings = conditions.settings(SETTINGS)
    assert settings.action_high == (3.0, 0.34)
    assert settings.barrier("speed_high") == pytest.approx(3.3)
    assert replace(settings, action_high=SETTINGS.action_high, barriers=SETTINGS.barriers) == SETTINGS


def test_a_quicker_policy_wants_the_same_ways_faster_and_backs_off_as_before() -> None:
    model, state = load_model("car"), Conditions().robot(3000, LOAD).state_message()
    nominal_actions = []
    for speed in (1.0, 1.5):
        (policy,) = Conditions(speed=speed).nodes([PolicyNode(model)])
        nominal_actions.append(policy.step("r1", state, {LATENT: None})[NOMINAL].values)  # type: ignore[dict-item, union-attr]
    assert nominal_actions[1] == pytest.approx((1.5 * nominal_actions[0][0], nominal_actions[0][1]))
    assert nominal_actions[0][0] > 0.0


def test_noise_has_its_stated_size_and_is_the_same_for_every_method() -> None:
    conditions = Conditions(noise=0.02)
    shown = []
    for _ in range(2):
        robot = conditions.robot(3000, LOAD)
        measured = conditions.measured(robot)
        errors = np.array([np.subtract(measured.state_message().values, robot.values) for _ in range(400)])
        shown.append(errors)
    assert np.array_equal(*shown)
    assert shown[0].std(axis=0) == pytest.approx((0.02, 0.02, 0.02 / 0.32, 0.1), rel=0.12)
    robot = Conditions().robot(3000, LOAD)
    assert Conditions().measured(robot) is robot


def test_a_delay_is_known_to_the_filter_or_unknown() -> None:
    """The same late commands; the filter that knows of them decides otherwise."""
    reported, untold = Conditions(delay=0.15), Conditions(delay=0.15, reported=False)
    assert reported.robot(3000, LOAD).state_message().until_action == 0.15
    assert untold.robot(3000, LOAD).state_message().until_action == 0.0
    drives = [outcomes(conditions, 60)[0] for conditions in (Conditions(), reported, untold)]
    assert len({drive.trajectory for drive in drives}) == 3


def test_the_load_is_hitched_and_let_go_once_a_third_of_the_way_is_driven() -> None:
    (hitched,), (let_go,), (never,), (always,) = (
        outcomes(Conditions(towing=towing), 80, (3001,)) for towing in ("from_a_third", "to_a_third", "never", "always")
    )
    for drive in (hitched, let_go):
        assert drive.load_changed is not None
        assert drive.load_changed > 10
    assert never.load_changed is always.load_changed is None
    assert len({drive.trajectory for drive in (hitched, let_go, never, always)}) == 4
    assert Conditions(towing="never").robot(3000, LOAD).scene.obstacles == car_scene(3000, LOAD).obstacles


@pytest.mark.parametrize(
    ("changed", "reported"),
    [
        ({"friction": 0.0}, "friction: got 0.0, wanted a finite number, more than 0"),
        ({"speed": float("nan")}, "speed: got nan"),
        ({"noise": -0.01}, "noise: got -0.01, wanted a finite number, 0 or more"),
        ({"towing": "allways"}, "did you mean 'always'"),
    ],
)
def test_invalid_conditions_are_refused(changed: dict[str, Any], reported: str) -> None:
    with pytest.raises(InputError, match=reported):
        Conditions(**changed)


def test_only_a_chair_is_hitched_on_the_way() -> None:
    assert set(SWEEPS["towing"].values) == set(map(float, range(len(TOWING))))
    with pytest.raises(InputError, match="got 'box', wanted 'chair'"):
        Conditions(towing="from_a_third").robot(0, "box")


def driven(safe: str, reached: str) -> list[Outcome]:
    """Of episodes given as 1 and 0."""
    return [
        Outcome(seed, good == "1", unhurt == "1", 100, "", 0, 0, 0.1, {}, {}, "")
        for seed, (unhurt, good) in enumerate(zip(safe, reached, strict=True))
    ]


def test_safedpa_is_compared_pair_by_pair_and_corrected_for_every_comparison() -> None:
    """By hand: 10 episodes with SafeDPA alone and none with the other, p = 2 / 2^10; the smallest of four, times 4."""
    ones, noughts = "1" * 10, "0" * 10
    places = {
        "easy": {"rma": driven(ones, ones), "safedpa": driven(ones, ones)},
        "hard": {"safedpa": driven(ones, noughts), "rma": driven(noughts, ones)},
    }
    rows = {(row["place"], row["measure"]): row for row in advantages(places, ("safe", "both"))}
    assert len(rows) == 4
    hard = rows["hard", "safe"]
    assert (hard["only_safedpa"], hard["only_other"], hard["against"]) == (10, 0, "rma")
    assert (hard["mcnemar"], hard["holm"]) == (2 / 2**10, 8 / 2**10)
    assert rows["hard", "both"]["holm"] == rows["easy", "safe"]["holm"] == 1.0
    assert advantages({"easy": {"rma": driven("1", "1")}}) == []


@pytest.mark.long
def test_the_command_writes_tables_picture_and_every_point(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the first and last value of two sweeps, with two methods without networks and as few drives as make one."""
    for name in ("friction", "noise"):
        values, shown = SWEEPS[name].values, SWEEPS[name].shown
        ends = replace(SWEEPS[name], values=(values[0], values[-1]), names=(shown[0], shown[-1]))
        monkeypatch.setitem(SWEEPS, name, ends)
    monkeypatch.setattr("safedpa_lab.experiments.car.drives.EARNEST", 1)
    phrase, out = ["experiment", "car-curves", "--models", str(NOWHERE)], tmp_path / "new" / "folder"
    phrase += ["--sweep", "friction", "--sweep", "noise", "--method", "physics", "--method", "goal_seeker"]
    phrase += ["--episodes", "1", "--drives", "1", "--processes", "1", "--out", str(out)]
    assert safedpa.run(phrase) == 0
    reported = json.loads((out / "car-curves.json").read_text())
    assert reported["seeds"] == [1000, 1000]
    assert reported["sweeps"].keys() == {"friction", "noise"}
    points = reported["sweeps"]["noise"]["points"]
    assert [(point["method"], point["shown"]) for point in points] == [
        ("physics", "0"), ("goal_seeker", "0"), ("physics", "4"), ("goal_seeker", "4"),
    ]  # fmt: skip
    assert points[:2] == [
        {**point, "value": 0.0, "shown": "0"} for point in reported["sweeps"]["friction"]["points"][:2]
    ]
    assert all(point["safe"]["of"] == 1 and len(point["both"]["interval_95"]) == 2 for point in points)
    assert points[0]["safe"]["hits"] == 1
    page = (out / "car-curves.md").read_text()
    assert "| noise of x and y [cm] | | 0 | 4 |" in page
    assert "| Physics model | safety | 1.00 [0.21, 1.00] |" in page
    with Image.open(out / "car-curves.png") as picture:
        colours = {colour for _, colour in picture.convert("RGB").getcolors(10**6) or ()}
    wanted = {
        tuple(int(METHOD_COLOURS[name][at : at + 2], 16) for at in (1, 3, 5)) for name in ("physics", "goal_seeker")
    }
    assert wanted <= colours


def test_sweeps_are_listed_in_their_own_order() -> None:
    assert [sweep.name for sweep in chosen_sweeps(("noise", "passage"))] == ["passage", "noise"]
    assert (chosen_sweeps(()), SWEEPS["passage"].usual) == (list(SWEEPS.values()), PASSAGE)
