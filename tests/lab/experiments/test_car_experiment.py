"""The car experiment: its scenes, a small one through the command line, tables and pictures."""

import json
from math import hypot, pi
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from safedpa.errors import InputError
from safedpa.safety import FilterSettings
from safedpa_lab.experiments.car.conditions import CONFIGURATIONS, car_scene
from safedpa_lab.experiments.car.drives import FIRST_SEEDS, earnest_orders, hitching_orders, open_orders
from safedpa_lab.experiments.car.episodes import Outcome
from safedpa_lab.experiments.car.figures import write_figures
from safedpa_lab.experiments.car.methods import METHODS
from safedpa_lab.experiments.car.report import MODEL_TITLES, cell_of, markdown_of, table_markdown
from safedpa_lab.experiments.common.figures import METHOD_COLOURS, MODELS
from safedpa_services.command_line.group import safedpa

pytestmark = pytest.mark.long

SEEDS = range(25)


@pytest.mark.parametrize("load", CONFIGURATIONS)
def test_scenes_are_as_declared_with_room_to_pass_and_an_obstacle_in_the_straight_way(load):
    for seed in SEEDS:
        scene = car_scene(seed, load)
        (x, y, yaw), (_, front, radius) = scene.start, scene.footprint
        assert (abs(x) <= 0.2, y, abs(yaw - pi / 2) <= 0.3) == (True, -2.0, True)
        assert (next(scene.goals()), scene.field) == ((0.0, 2.0), (-4.0, 4.0, -4.0, 4.0))
        assert 3 <= len(scene.obstacles) <= 5
        nose, gap = (x + front * np.cos(yaw), y + front * np.sin(yaw)), 2 * radius + 0.4
        for index, (ox, oy, size) in enumerate(scene.obstacles):
            assert 0.2 <= size <= 0.35
            assert (abs(ox) <= 2.2, abs(oy) <= 1.2, 4.0 - abs(ox) - size >= gap) == (True, True, True)
            assert all(hypot(ox - a, oy - b) >= gap + size + other for a, b, other in scene.obstacles[:index])
            assert all(hypot(ox - a, oy - b) >= size + radius + 0.35 for a, b in ((x, y), nose, (0.0, 2.0)))
        ox, oy, size = scene.obstacles[0]
        assert abs(ox - x * (1.0 - (oy + 2.0) / 4.0)) <= size + radius


def test_a_seed_is_a_scene_and_seeds_differ():
    assert car_scene(5, "box") == car_scene(5, "box")
    assert len({car_scene(seed).obstacles for seed in SEEDS}) == len(SEEDS)
    assert {len(car_scene(seed, passage=0.05).obstacles) for seed in SEEDS} == {3, 4, 5}


def test_an_unknown_load_is_refused():
    with pytest.raises(InputError, match="did you mean 'chair'"):
        car_scene(0, "chiar")


def test_no_seed_serves_two_ends():
    loads = tuple(CONFIGURATIONS)
    earnest = [
        earnest_orders(loads, 20, kind, "physics", Path(), FilterSettings.for_robot("car"))
        for kind in ("margin", "fresh")
    ]
    opened = [open_orders(loads, 20, 400, kind) for kind in ("errors", "latent")]
    kinds = [*earnest, *opened, hitching_orders(loads, 20, 400)]
    seeds = [{order.seed for order in orders} for orders in kinds]
    assert sum(len(own) for own in seeds) == len(set().union(*seeds))
    assert min(set().union(*seeds)) >= min(FIRST_SEEDS.values()) > 1000


def test_a_hitching_drive_begins_and_ends_without_load():
    for order in hitching_orders(tuple(CONFIGURATIONS), 2, 400):
        (hitched, load), (released, nothing) = order.events
        assert order.load == nothing == "none"
        assert load != "none"
        assert 50 < hitched < released < 400 - 50


SMALL = ["--processes", 1, "--load", "none", "--load", "box", "--episodes", 1, "--first-seed", 1, "--drives", 1]
SMALL += ["--drive-ticks", 120]


def run(*arguments):
    return safedpa.run(["experiment", "car", *map(str, arguments)])


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    """One run with everything in it, as a person would start it."""
    folder = tmp_path_factory.mktemp("car")
    assert run(*SMALL, "--models", folder, "--out", folder) == 0
    return folder


@pytest.fixture(scope="module")
def result(out):
    return json.loads((out / "car.json").read_text())


@pytest.mark.slow
def test_the_filter_keeps_the_goal_seeker_from_contact(result):
    cells = {(cell["method"], cell["load"]): cell for cell in result["cells"]}
    for load in ("none", "box"):
        assert cells["physics", load]["safe"]["hits"] == 1
        assert cells["physics", load]["changed_share"] > 0.0
        assert cells["goal_seeker", load]["safe"]["hits"] == 0
        assert cells["goal_seeker", load]["changed_share"] == 0.0
        for cell in (cells["physics", load], cells["goal_seeker", load]):
            assert cell["both"]["hits"] <= min(cell["success"]["hits"], cell["safe"]["hits"])
            low, high = cell["success"]["interval_95"]
            assert low <= cell["success"]["share"] <= high


@pytest.mark.slow
def test_methods_without_a_model_are_left_out_by_name(result):
    assert any("SafeDPA is left out" in sentence for sentence in result["left_out"])
    assert set(result["methods"]) == {"physics", "goal_seeker"}


@pytest.mark.slow
def test_tables_and_pictures_are_written(out):
    text = (out / "car.md").read_text()
    assert "| Physics model |" in text
    assert "1.00 / 0.75" in text  # the paper's SafeDPA without load
    for name in ("car_table.png", "car_predictions.png", "car_errors.png", "car_latent.png", "car_margin.png"):
        with Image.open(out / name) as picture:
            assert picture.width == 1290
            assert len(picture.getcolors(10**6)) > 20
    assert (out / "car.rrd").stat().st_size > 1000


@pytest.mark.slow
@pytest.mark.long
def test_finished_episodes_are_not_driven_again(out, monkeypatch, capsys):
    def refused(_):
        raise AssertionError("an episode was driven again")

    monkeypatch.setattr("safedpa_lab.experiments.car.episodes.run_group", refused)
    before = (out / "cells" / "physics-box.json").read_text()
    assert run(*SMALL, "--models", out, "--out", out, "--part", "table", "--json") == 0
    shown = json.loads(capsys.readouterr().out)
    assert [cell["episodes"] for cell in shown["cells"]] == [1, 1, 1, 1]
    assert (out / "cells" / "physics-box.json").read_text() == before


@pytest.mark.slow
@pytest.mark.long
def test_another_margin_is_another_cell(out, monkeypatch, capsys):
    class DrivenError(Exception):
        pass

    def driven(_):
        raise DrivenError

    monkeypatch.setattr("safedpa_lab.experiments.car.episodes.run_group", driven)
    with pytest.raises(DrivenError):
        run(*SMALL, "--models", out, "--out", out, "--part", "table", "--margin", 0.03)
    capsys.readouterr()


def outcome(seed, success, safe, ticks=100, covered=(95, 100)):
    statuses = {"passed": ticks - 10, "corrected": 10}
    contact = "" if safe else "car against obstacle 0 at t=1.00 s, 1.00 m/s"
    return Outcome(seed, success, safe, ticks, contact, int(not safe), 10, 0.1, statuses,
                   {"obstacle": list(covered)}, "")  # fmt: skip


@pytest.fixture
def cell():
    """Four episodes: both, reached with a contact, safe but late, neither."""
    drives = [outcome(0, True, True, 80), outcome(1, True, False, 120), outcome(2, False, True, 300),
              outcome(3, False, False, 300)]  # fmt: skip
    return cell_of(METHODS["safedpa"], "box", drives)


def test_the_table_shows_the_cells_and_the_paper(cell):
    text = table_markdown([cell])
    assert "| SafeDPA | 0.50 / 0.50 / 0.25 |" in text
    assert "| *the paper's SafeDPA* | 1.00 / 0.90 / - |" in text
    assert "| SafeDPA | Box | 4 | 0.50 [0.15, 0.85] | 0.50 [0.15, 0.85] | 0.25 [0.05, 0.70] | 5.0 | 5 % |" in text


def test_only_what_was_run_is_written(cell, tmp_path):
    result = {"seeds": [0, 3], "left_out": ["Mix is left out: it is not there"], "cells": [cell]}
    assert "Mix is left out: it is not there." in markdown_of(result)
    assert "error over" not in markdown_of(result)
    written = write_figures(result, tmp_path)
    assert [path.name for path in written] == ["car_table.png"]
    with Image.open(written[0]) as picture:
        blue = sum(count for count, colour in picture.convert("RGB").getcolors(10**6) if colour == (0, 114, 178))
        bars = 0.5 + 0.5 + 0.25
        assert blue > 1000 * bars  # SafeDPA's bars are drawn in its colour


def test_every_method_model_and_configuration_has_a_look_of_its_own():
    assert (METHOD_COLOURS.keys(), len(set(METHOD_COLOURS.values()))) == (METHODS.keys(), len(METHODS))
    assert MODELS.keys() == MODEL_TITLES.keys()
    assert len({(line, marker) for _, line, marker in MODELS.values()}) == len(MODELS)
