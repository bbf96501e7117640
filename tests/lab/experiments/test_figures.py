"""What figures of experiments show, read from Matplotlib's own objects."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from safedpa_lab.experiments import car_figure_curves, car_figure_margin, car_figure_table, sensing_curves
from safedpa_lab.experiments.car_methods import METHODS
from safedpa_lab.experiments.car_style import MODELS


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Draws with a module, without a file, and returns the figure."""

    def draw(module: ModuleType, function: Any, result: dict[str, Any]) -> Figure:
        figures: list[Figure] = []

        @contextmanager
        def figure(*_: Any) -> Iterator[Figure]:
            figures.append(Figure(layout="constrained"))
            yield figures[0]

        monkeypatch.setattr(module, "figure", figure)
        function(result, None)
        return figures[0]

    return draw


def ends(container: Any) -> list[list[float]]:
    """Lower and upper ends of the bars of errors."""
    return [[round(float(y), 6) for _, y in segment] for segment in container[2][0].get_segments()]


@pytest.mark.parametrize(
    ("cells", "columns"),
    [
        ([("safedpa", "box")], 1),
        ([("safedpa", "box"), ("safedpa", "none"), ("rma", "none")], 2),
        ([("safedpa", "box"), ("rma", "chair"), ("physics", "large_chair")], 3),
    ],
)
def test_a_table_has_a_panel_for_each_measure_and_load_and_a_bar_for_each_cell(
    cells: list[tuple[str, str]], columns: int, drawn: Any
) -> None:
    share = {"share": 0.25, "interval_95": [0.125, 0.5]}
    rows = [
        {"method": name, "load": load, "episodes": 9, "paper": None, "success": share, "safe": share, "both": share}
        for name, load in cells
    ]
    panels = drawn(car_figure_table, car_figure_table.table_figure, {"cells": rows}).axes
    assert len(panels) == 3 * columns
    bars = [bar for axes in panels for bar in axes.patches]
    lines = [line for axes in panels for line in axes.lines]
    assert [bar.get_width() for bar in bars] == [0.25] * 3 * len(cells)
    assert [list(line.get_xdata()) for line in lines] == [[0.125, 0.5]] * 3 * len(cells)
    assert {text.get_text() for axes in panels for text in axes.texts} == {"25 %"}
    names = [name for name in METHODS if name in {name for name, _ in cells}]
    assert [text.get_text() for text in panels[0].get_yticklabels()] == [METHODS[name].title for name in names]


@pytest.mark.parametrize("curves", [("noise",), ("walking", "latency")])
def test_curves_of_a_laser_are_drawn_in_per_cent_over_goals_a_minute(curves: tuple[str, ...], drawn: Any) -> None:
    rows = [
        {"curve": name, "value": value, "drives": 8, "drives_in_which_the_car_moved_into_something": hits,
         "share_95": (0.0625, 0.5), "goals_a_minute": goals, "goals_a_minute_told_everything": 5.0}
        for name in curves for value, hits, goals in ((0.5, 1, 2.0), (1.0, 2, 4.0))
    ]  # fmt: skip
    panels = drawn(sensing_curves, sensing_curves.draw_curves, {"rows": rows}).axes
    assert len(panels) == 2 * len(curves)
    for above, below in zip(panels[: len(curves)], panels[len(curves) :], strict=True):
        (bars,) = above.containers
        assert list(bars[0].get_ydata()) == [12.5, 25.0]
        assert ends(bars) == [[6.25, 50.0], [6.25, 50.0]]
        own, known = (line for line in below.lines if len(line.get_ydata()) == 2 and line.get_ydata()[0] > 1.0)
        assert (list(own.get_ydata()), list(known.get_ydata())) == ([2.0, 4.0], [5.0, 5.0])
        assert below.get_ylim() == pytest.approx((-0.22, 5.5))


def test_curves_of_the_car_are_drawn_in_per_cent_and_their_names_do_not_overlap(drawn: Any) -> None:
    """Names stay at their curve's end where others leave room, and are moved down otherwise."""
    shares = {"safedpa": (0.25, 0.99), "rma": (0.5, 1.0), "rma_p": (0.0, 0.98), "physics": (0.5, 0.3)}
    points = [
        {"method": name, "episodes": 9,
         "safe": (cell := {"share": own[place], "interval_95": [own[place] - 0.125, own[place] + 0.25]}), "both": cell}
        for place in (0, 1) for name, own in shares.items()
    ]  # fmt: skip
    sweep = {"label": "noise", "shown": ["0", "1"], "values": [0.0, 1.0], "usual": 0.0, "advantages": []}
    sweep["points"] = points
    result = {"sweeps": {"noise": sweep}, "family": {"name": "best"}, "load": "chair"}
    panel = drawn(car_figure_curves, car_figure_curves.curves_figure, result).axes[0]
    found = {tuple(bars[0].get_ydata()): np.array(ends(bars)) for bars in panel.containers}
    assert set(found) == {(100 * one, 100 * other) for one, other in shares.values()}
    for share, bars in found.items():
        np.testing.assert_allclose(bars, np.transpose([np.array(share) - 12.5, np.array(share) + 25.0]), atol=1e-6)
    heights = {text.get_text(): text.xy[1] for text in panel.texts}
    wanted = [METHODS[name].title.replace(" model", "") for name in ("rma", "safedpa", "rma_p", "physics")]
    assert sorted(heights, key=lambda name: -heights[name]) == wanted
    placed = [heights[name] for name in wanted]
    assert (placed[0], placed[-1]) == (pytest.approx(100.0), pytest.approx(30.0))
    assert min(-np.diff(placed)) >= 11.0 - 1e-9


def test_coverage_of_margins_is_drawn_in_per_cent_with_its_ends(drawn: Any) -> None:
    name = next(iter(MODELS))
    told = {"epsilon": 0.1, "share": 0.75, "interval_95": [0.5, 1.0]}
    models = {name: {"obstacle": {"conformal": told, "theorem": told | {"epsilon": 0.4}}}}
    result = {"margin": {"models": models, "coverage_wanted": 0.99}}
    left, right = drawn(car_figure_margin, car_figure_margin.margin_figure, result).axes
    assert sorted(bar.get_height() for bar in left.patches) == [0.1, 0.4]
    assert [list(map(float, line.get_ydata())) for line in right.lines] == [[50.0, 100.0], [75.0], [99.0, 99.0]]
