"""What figures draw, what is measured with noise and how errors of models are summed, from numbers by hand."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa_lab.experiments import (
    car_conditions,
    car_errors,
    car_figure_curves,
    car_figure_margin,
    car_figure_table,
    car_latent,
    pendulum_figures,
    sensing_curves,
    sensing_scores,
)
from safedpa_lab.experiments.car_methods import METHODS
from safedpa_lab.experiments.car_scenes import FIELD, _row, car_scene
from safedpa_lab.experiments.car_style import MODELS
from safedpa_lab.experiments.hostile.driven import DrivenLoop


class Axes:
    """Remembers every call by its name."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, tuple[Any, ...], dict[str, Any]]] = []

    def __getattr__(self, name: str) -> Any:
        def call(*given: Any, **named: Any) -> Any:
            self.calls.append((name, given, named))
            return (0.0, 1.0) if name.startswith("get_") else Axes()

        return call

    def of(self, name: str) -> list[tuple[tuple[Any, ...], dict[str, Any]]]:
        """Arguments of the calls of that name."""
        return [(given, named) for own, given, named in self.calls if own == name]


class Drawn(Axes):
    """A figure whose panels are remembered."""

    def subplots(self, rows: int, columns: int, **_: Any) -> Any:
        self.shape = rows, columns
        self.panels = np.empty(self.shape, dtype=object)
        for place in np.ndindex(self.shape):
            self.panels[place] = Axes()
        return self.panels


def drawing(module: Any, monkeypatch: pytest.MonkeyPatch) -> Drawn:
    drawn = Drawn()

    @contextmanager
    def figure(*_: Any) -> Iterator[Drawn]:
        yield drawn

    monkeypatch.setattr(module, "figure", figure)
    monkeypatch.setattr(module, "bare", lambda _: None)
    monkeypatch.setattr(module, "heading", lambda *_: None)
    return drawn


@pytest.mark.parametrize(
    ("cells", "shape", "bars"),
    [
        ([("safedpa", "box")], (3, 1), 1),
        ([("safedpa", "box"), ("safedpa", "none"), ("rma", "none")], (3, 2), 3),
        ([("safedpa", "box"), ("rma", "chair"), ("physics", "large_chair")], (3, 3), 3),
    ],
)
def test_a_table_has_a_panel_for_each_load_and_a_bar_for_each_cell(
    cells: list[tuple[str, str]], shape: tuple[int, int], bars: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn = drawing(car_figure_table, monkeypatch)
    share = {"share": 0.25, "interval_95": [0.125, 0.5]}
    rows = [
        {"method": name, "load": load, "episodes": 9, "paper": None, "success": share, "safe": share, "both": share}
        for name, load in cells
    ]
    car_figure_table.table_figure({"cells": rows}, None)  # type: ignore[arg-type]
    assert drawn.shape == shape
    for line in drawn.panels:
        found = [bar for axes in line for bar in axes.of("barh")]
        assert len(found) == bars
        assert all(given[1] == 0.25 for given, _ in found)
        assert [given[:2] for axes in line for given, _ in axes.of("plot")] == [
            ([0.125, 0.5], [given[0]] * 2) for given, _ in found
        ]  # fmt: skip
        assert {given[2] for axes in line for given, _ in axes.of("text")} == {"25 %"}
    names = list(dict.fromkeys(name for name in METHODS if name in {name for name, _ in cells}))
    for axes in drawn.panels.flat:
        (given, _), *_rest = axes.of("set_yticks")
        assert list(given[0]) == list(range(len(names)))
        assert given[1] == [METHODS[name].title for name in names]


@pytest.mark.parametrize("curves", [("noise",), ("walking", "latency")])
def test_of_curves_those_are_drawn_that_were_driven(curves: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = drawing(sensing_curves, monkeypatch)
    rows = [
        {"curve": name, "value": value, "drives": 8, "drives_in_which_the_car_moved_into_something": hits,
         "share_95": (0.0625, 0.5), "goals_a_minute": goals, "goals_a_minute_told_everything": 5.0}
        for name in curves for value, hits, goals in ((0.5, 1, 2.0), (1.0, 2, 4.0))
    ]  # fmt: skip
    sensing_curves.draw_curves({"rows": rows}, None)  # type: ignore[arg-type]
    assert drawn.shape == (2, len(curves))
    for above, below in drawn.panels.T:
        ((given, _),) = above.of("errorbar")
        assert given[1].tolist() == [12.5, 25.0]
        assert [ends.tolist() for ends in given[2]] == [[6.25, 18.75], [37.5, 25.0]]
        assert [given[1] for given, _ in below.of("plot")] == [[2.0, 4.0], [5.0, 5.0]]
        ((low, high), _), *_rest = below.of("set_ylim")
        assert high == pytest.approx(5.5)
        assert low == pytest.approx(-0.22)


def test_a_curve_is_drawn_in_per_cent_with_its_ends() -> None:
    points = [
        {"method": name, "safe": {"share": share, "interval_95": [share - 0.125, share + 0.25]}}
        for share in (0.25, 0.5) for name in ("safedpa", "rma")
    ]  # fmt: skip
    low, share, high = car_figure_curves._curve({"points": points}, "rma", "safe")
    assert (low.tolist(), share.tolist(), high.tolist()) == ([12.5, 37.5], [25.0, 50.0], [50.0, 75.0])
    assert car_figure_curves._methods({"points": points}) == ["safedpa", "rma"]


@pytest.mark.parametrize(
    ("heights", "found"),
    [([50.0, 20.0], [50.0, 20.0]), ([50.0, 50.0], [50.0, 45.0]), ([99.0, 101.0, 100.0], [91.0, 101.0, 96.0]),
     ([110.0], [101.0]), ([10.0, 12.0, 60.0], [7.0, 12.0, 60.0])],
)  # fmt: skip
def test_names_are_moved_down_no_more_than_needed(heights: list[float], found: list[float]) -> None:
    assert car_figure_curves._spread(heights, 5.0, 101.0) == found


def test_coverage_is_drawn_in_per_cent_with_its_ends() -> None:
    axes: Any = Axes()
    kind = next(iter(car_figure_margin._KINDS))
    name = next(iter(MODELS))
    car_figure_margin._coverage(axes, name, {kind: {"conformal": {"share": 0.75, "interval_95": [0.5, 1.0]}}}, 0.25)
    assert [given[:2] for given, _ in axes.of("plot")] == [([0.25, 0.25], [50.0, 100.0]), (0.25, 75.0)]


@pytest.mark.parametrize(
    ("angles", "colour"),
    [
        ((100.0, 200.0, 359.0), "blue"), ((100.0, 255.0, 359.0), "red"), ((255.0, 255.0), "red"),
        ((100.0, 200.0, 180.0), "grey"), ((100.0, 615.0, 362.0), "red"), ((10.0, -105.0, 1.0), "red"),
        ((240.0, 359.0), "blue"), ((100.0, 354.0), "grey"),
    ],
)  # fmt: skip
def test_a_swing_that_was_in_the_hazard_at_any_moment_is_red(
    angles: tuple[float, ...], colour: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From 250 to 260 degrees; upright is 0 or 360, to 5 degrees."""
    monkeypatch.setattr(pendulum_figures, "bare", lambda _: None)
    for name, said in (("_SAFE", "blue"), ("_UNSAFE", "red"), ("_STUCK", "grey")):
        monkeypatch.setattr(pendulum_figures, name, said)
    axes: Any = Axes()
    row = {"shown": [[(math.radians(angle), 0.0) for angle in angles]], "episodes": 8, "success": 2, "safe": 6,
           "title": "T"}  # fmt: skip
    pendulum_figures._portrait(axes, row, [math.radians(250.0), math.radians(260.0)])
    ((given, named),) = axes.of("plot")
    assert named["color"] == colour
    assert given[0].tolist() == pytest.approx(list(angles))
    assert axes.of("set_title")[0][0] == ("T\nupright 25 %, safe 75 %",)


@pytest.mark.parametrize(
    ("safe", "success", "good"), [("110011", None, [1.0, 0.0, 1.0]), ("110111", "101001", [0.5, 0.0, 0.5])]
)
def test_the_share_of_good_episodes_by_direction(safe: str, success: str | None, good: list[float]) -> None:
    row = {"safe_each": safe} | ({} if success is None else {"success_each": success})
    assert pendulum_figures._good(row, 3).tolist() == good


def test_every_figure_of_the_pendulum_has_its_file(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    written: dict[str, str] = {}
    for name in ("_directions", "_portraits", "_reserve", "_latent", "draw_sweeps"):
        monkeypatch.setattr(
            pendulum_figures, name, lambda _, path, name=name: written.update({name: str(path.relative_to(tmp_path))})
        )
    pendulum_figures.write_figures({"sweeps": {}}, tmp_path)
    assert written == {
        "_directions": "pendulum_balancing.png", "_portraits": "pendulum_hazard.png",
        "_reserve": "pendulum_invariance.png", "_latent": "pendulum_latent.png",
    }  # fmt: skip
    pendulum_figures.write_figures({"sweeps": {"wind": {}}}, tmp_path)
    assert written["draw_sweeps"] == "pendulum_sweeps.png"


@dataclasses.dataclass(frozen=True)
class State:
    values: tuple[float, ...]


@pytest.mark.parametrize("noise", [0.01, 0.5])
def test_a_noisy_robot_measures_each_number_with_its_own_deviation(noise: float) -> None:
    """What a position is off by over the base of a heading or of a speed, which it would be taken from."""
    robot: Any = SimpleNamespace(
        scene=SimpleNamespace(seed=3), receive=None, advance=None, state_message=lambda: State((1.0, 2.0, 3.0, 4.0))
    )
    made = car_conditions.NoisyRobot(robot, noise)
    seen = np.array([made.state_message().values for _ in range(4000)]) - (1.0, 2.0, 3.0, 4.0)
    wanted = [noise, noise, noise / car_conditions._YAW_BASE, noise / car_conditions._SPEED_BASE]
    np.testing.assert_allclose(seen.std(axis=0), wanted, rtol=0.05)
    np.testing.assert_allclose(seen.mean(axis=0), 0.0, atol=4.0 * max(wanted) / math.sqrt(4000))
    again = car_conditions.NoisyRobot(robot, noise)
    assert again.state_message().values == tuple(np.array((1.0, 2.0, 3.0, 4.0)) + seen[0])


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_scene_begins_towards_its_goal_with_three_to_five_obstacles(seed: int) -> None:
    scene, goal = car_scene(seed), (0.0, 2.0)
    assert abs(scene.start[2] - math.pi / 2.0) <= 0.3
    assert 3 <= len(scene.obstacles) <= 5
    across = [
        abs(x - scene.start[0] - (goal[0] - scene.start[0]) * (y - scene.start[1]) / 4.0) - r
        for x, y, r in scene.obstacles
    ]
    assert min(across) < 0.13, "one stands in the straight way of 0.24 m"
    row = _row(np.random.default_rng(seed), scene.start, goal, None, 0.4)
    xs = sorted((x - r, x + r) for x, _, r in row)
    gaps = [later[0] - before[1] for before, later in pairwise(xs)]
    assert gaps == pytest.approx([0.64] * (len(row) - 1))
    assert xs[0][0] <= FIELD[0]
    assert xs[-1][1] >= FIELD[1]


def test_errors_over_the_scale_and_in_units_by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    errors = np.array([[3.0, 0.0, 1.0, 2.0], [-4.0, 0.0, -1.0, 2.0]])
    found = car_errors._summary(errors, np.array([5.0, 1.0, 2.0, 4.0]))
    each = [math.sqrt(12.5) / 5.0, 0.0, 0.5, 0.5]
    assert list(found["per_state"].values()) == pytest.approx(each)
    assert list(found["root_mean_square"].values()) == pytest.approx([math.sqrt(12.5), 0.0, 1.0, 2.0])
    assert (found["count"], found["position"]) == (2, pytest.approx(math.sqrt(12.5)))
    assert found["number"] == pytest.approx(sum(each) / 4.0)


def test_the_scale_is_the_root_mean_square_of_what_changes_in_a_step(monkeypatch: pytest.MonkeyPatch) -> None:
    frame = SimpleNamespace(own_increment=lambda before, after: after - before)
    monkeypatch.setattr(car_errors, "frame_of", lambda _: frame)
    drives: Any = [
        SimpleNamespace(states=np.array([[0.0, 0.0], [3.0, 1.0], [-1.0, 0.0]])),
        SimpleNamespace(states=np.array([[5.0, 7.0], [5.0, 9.0]])),
    ]
    assert car_errors.increment_scale([], drives).tolist() == pytest.approx([math.sqrt(25 / 3), math.sqrt(2.0)])
    monkeypatch.setattr(car_latent, "frame_of", lambda _: frame)
    monkeypatch.setattr(
        car_latent, "predictor_of", lambda *_: SimpleNamespace(one_step=lambda: np.array([[6.0, 1.0], [-1.0, 8.0]]))
    )
    sizes = car_latent._error_sizes(None, drives[0], np.array([3.0, 4.0]))  # type: ignore[arg-type]
    assert sizes.tolist() == pytest.approx([math.sqrt(0.5), math.sqrt(2.0)])


def test_messages_that_no_service_took_are_those_of_all_services() -> None:
    loop = object.__new__(DrivenLoop)
    loop._services = [SimpleNamespace(_strangers=SimpleNamespace(refused=n)) for n in (2, 0, 5)]  # type: ignore[misc]
    assert loop.refused == 7


def scan(*ranges: float) -> Any:
    """Rays to 0, 90, 180 and 270 degrees from the middle of the robot."""
    return SimpleNamespace(
        mount=(0.0, 0.0, 0.0), first_angle=0.0, angle_step=math.pi / 2.0, nearest=0.05, ranges=ranges
    )


@pytest.mark.parametrize(
    ("ranges", "own", "hit"),
    [
        ((9.0, 9.0, 9.0, 1.5), 0, True), ((9.0, 9.0, 9.0, 1.55), 0, True), ((9.0, 9.0, 9.0, 1.65), 0, False),
        ((9.0, 9.0, 9.0, 1.35), 0, False), ((1.5, 1.5, 1.5, 9.0), 0, False), ((9.0, 9.0, 9.0, 1.5), 1, False),
    ],
)  # fmt: skip
def test_somebody_is_seen_where_a_ray_ends_on_him_and_not_on_the_robot(
    ranges: tuple[float, ...], own: int, hit: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A disc of 0.5 m, 2 m to the right, at the end of the last of four rays; ``own``: the robot itself is there."""
    monkeypatch.setattr(sensing_scores, "within_body", lambda ends, *_: np.full(len(ends), bool(own)))
    assert sensing_scores._hit(scan(*ranges), (0.0, 0.0, 0.0), None, (0.0, -2.0, 0.5)) is hit  # type: ignore[arg-type]


def test_of_two_rays_on_somebody_one_is_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sensing_scores, "within_body", lambda ends, *_: np.arange(len(ends)) == 0)
    seen = SimpleNamespace(mount=(0.0, 0.0, 0.0), first_angle=-0.1, angle_step=0.1, nearest=0.05, ranges=(1.5,) * 3)
    assert sensing_scores._hit(seen, (0.0, 0.0, 0.0), None, (2.0, 0.0, 0.5))  # type: ignore[arg-type]
