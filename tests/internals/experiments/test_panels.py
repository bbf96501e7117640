"""Single panels of large figures, whose whole results take an experiment to make."""

import math
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from safedpa_lab.experiments.pendulum import figures as pendulum_figures
from safedpa_lab.experiments.pendulum.figures import _pooled
from safedpa_lab.experiments.point.figures import _path


@pytest.mark.parametrize(
    ("angles", "colour"),
    [
        ((100.0, 200.0, 359.0), "_SAFE"), ((100.0, 255.0, 359.0), "_UNSAFE"), ((255.0, 255.0), "_UNSAFE"),
        ((100.0, 200.0, 180.0), "_STUCK"), ((100.0, 615.0, 362.0), "_UNSAFE"), ((10.0, -105.0, 1.0), "_UNSAFE"),
        ((240.0, 359.0), "_SAFE"), ((100.0, 354.0), "_STUCK"),
    ],
)  # fmt: skip
def test_a_swing_that_was_in_the_hazard_at_any_moment_is_drawn_as_unsafe(angles: tuple[float, ...], colour: str):
    """From 250 to 260 degrees; upright is 0 or 360, to 5 degrees."""
    axes = Figure().add_subplot()
    shown = [[(math.radians(angle), 0.0) for angle in angles]]
    row = {"shown": shown, "episodes": 8, "success": 2, "safe": 6, "title": "T"}
    pendulum_figures._portrait(axes, row, [math.radians(250.0), math.radians(260.0)])
    swing = axes.lines[0]
    assert swing.get_color() == getattr(pendulum_figures, colour)
    assert list(swing.get_xdata()) == pytest.approx(list(angles))
    assert axes.get_title() == "T\nupright 25 %, safe 75 %"


@pytest.mark.parametrize(
    ("safe", "success", "good"), [("110011", None, [1.0, 0.0, 1.0]), ("110111", "101001", [0.5, 0.0, 0.5])]
)
def test_the_share_of_good_episodes_is_counted_by_direction(safe: str, success: str | None, good: list[float]) -> None:
    row = {"safe_each": safe} | ({} if success is None else {"success_each": success})
    assert pendulum_figures._good(row, 3).tolist() == good


def test_the_filters_with_fixed_latents_are_pooled_with_all_their_episodes() -> None:
    rows = {
        "fix_0": {"episodes": 2, "safe": [1, 0, 2], "both": [0, 0, 1]}, "safedpa": {"episodes": 9, "safe": [9, 9, 8]},
        "fix_1": {"episodes": 3, "safe": [3, 1, 0], "both": [2, 1, 0]},
    }  # fmt: skip
    assert _pooled(rows) == {
        "safedpa": {"episodes": 9, "safe": [9, 9, 8]}, "fix": {"episodes": 5, "safe": [4, 1, 2], "both": [2, 1, 1]},
    }  # fmt: skip
    assert _pooled({"rma": {"episodes": 4}}) == {"rma": {"episodes": 4}}


@pytest.mark.parametrize(("reached_at", "drawn"), [([], 1), ([40], 2), ([40, 120, 499], 4), ([40, 120, 500, 700], 3)])
def test_goals_of_a_path_are_those_it_reached_within_ten_seconds_and_the_next(reached_at: list[int], drawn: int):
    goals = [(0.1 * number, 1.0) for number in range(6)]
    shown: dict[str, Any] = {
        "places": np.zeros((900, 2)).tolist(), "within": (np.arange(900) % 10 == 0).tolist(), "hazards": [(0.5, 0.5)],
        "goals": goals, "reached_at": reached_at,
    }  # fmt: skip
    axes = Figure().add_subplot()
    _path(axes, shown, "SafeDPA")
    assert [tuple(disc.center) for disc in axes.patches if not disc.get_fill()] == goals[:drawn]
    assert [text.get_text() for text in axes.texts] == [str(number) for number in range(1, drawn + 1)]
    assert axes.get_title() == "SafeDPA: 50 steps within"
