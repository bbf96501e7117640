"""The figure of what no effect explains: a map of the remaining rate, and its profile over one variable."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np

from safedpa.diagnosis.figures import COLOURS, LEGEND
from safedpa.diagnosis.panels import Panels, rounded
from safedpa.diagnosis.where import PLACE

__all__ = ["unexplained_figure"]


def unexplained_figure(unexplained: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """From ``unexplained`` of report.json; None where it holds neither map nor profile."""
    if not unexplained or not (unexplained.get("map") or unexplained.get("profile")):
        return None
    both = bool(unexplained.get("map")) and bool(unexplained.get("profile"))
    panels = Panels(rows=1, columns=2 if both else 1, height=400)
    if unexplained.get("map"):
        _map(panels, unexplained["map"])
    if unexplained.get("profile"):
        _profile(panels, unexplained["profile"])
    return panels.figure("unexplained", legend=LEGEND, margin={"l": 62, "r": 24, "t": 76, "b": 52})


def _map(panels: Panels, table: Mapping[str, Any]) -> None:
    """Blue below zero, orange above, white at zero: the sign is what an engineer asks first."""
    middles = [_middles(table[f"{side}_edges"]) for side in ("across", "up")]
    means = np.array([[np.nan if value is None else value for value in row] for row in table["means"]], dtype=float)
    most = float(np.nanmax(np.abs(means), initial=0.0)) or 1.0
    title = f"d({table['state']})/dt over {table['across']} and {table['up']}"
    x_title, y_title = (f"{table[side]} [{table[f'{side}_unit']}]" for side in ("across", "up"))
    at = panels.place(title, x_title, y_title, (0.0, 0.40 if panels.columns == 2 else 0.85), (0.0, 1.0))
    text = [[f"{count} windows" for count in row] for row in table["windows"]]
    z = [rounded(row) for row in means]
    panels.heat(at, rounded(middles[0]), rounded(middles[1]), z, text, table["rate_unit"])
    hover = f"{table['across']} %{{x:.3g}}, {table['up']} %{{y:.3g}}<br>%{{z:.3g}} {table['rate_unit']}<br>%{{text}}"
    scale = [[0.0, "#0072B2"], [0.5, "#F7F7F7"], [1.0, "#D55E00"]]
    bar = {"title": {"text": table["rate_unit"], "side": "top"}, "thickness": 14, "outlinewidth": 0}
    bar |= {"x": 0.41, "len": 0.9} if panels.columns == 2 else {}
    panels.data[-1].update(
        zmin=-most,
        zmax=most,
        colorscale=scale,
        reversescale=False,
        colorbar=bar,
        hovertemplate=hover + "<extra></extra>",
    )
    if (table["across"], table["up"]) == PLACE:
        panels.axis(at, "y", scaleanchor="x", constrain="domain")
        panels.axis(at, "x", constrain="domain")


def _profile(panels: Panels, table: Mapping[str, Any]) -> None:
    x_title, y_title = f"{table['variable']} [{table['unit']}]", f"d({table['state']})/dt [{table['rate_unit']}]"
    left = 0.58 if panels.columns == 2 else 0.0
    at = panels.place(f"to first order, over {table['variable']}", x_title, y_title, (left, 1.0), (0.0, 1.0))
    x = [float(value) for value in table["knots"]]
    bars = {"type": "data", "array": rounded(table["errors"]), "color": COLOURS["measured"], "thickness": 1.2}
    panels.draw(
        at, x, table["values"], mode="lines+markers", name="fitted, straight between; one standard deviation",
        error_y=bars, showlegend=True, marker={"size": 7}, line={"color": COLOURS["measured"], "width": 1},
    )  # fmt: skip
    if table.get("formula"):
        line = {"color": COLOURS["after"], "width": 3}
        panels.draw(at, x, table["formula"], mode="lines", name="the formula", showlegend=True, line=line)


def _middles(edges: Any) -> list[float]:
    return [0.5 * (low + high) for low, high in pairwise(edges)]
