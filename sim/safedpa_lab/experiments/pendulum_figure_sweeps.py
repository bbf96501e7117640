"""Both questions of the pendulum made harder: one panel for each number and each thing that is counted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from safedpa_lab.experiments.car_style import BLACK, BLUE, GREEN, GREY, ORANGE, PURPLE, RED, SKY, bare, figure, heading
from safedpa_lab.experiments.statistics import wilson_interval

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["draw_sweeps"]

_LOOKS: Final = {
    "oracle": ("knows the wind", BLACK, "s"),
    "safedpa": ("SafeDPA", BLUE, "o"),
    "goal_seeker": ("goal seeker, SafeDPA's filter", SKY, "P"),
    "mix": ("Mix", PURPLE, "v"),
    "fix": ("Fix (all four)", GREEN, "^"),
    "rma_p": ("RMA-P, best beta", ORANGE, "D"),
    "rma": ("RMA", RED, "X"),
    "ppo": ("PPO", GREY, "d"),
}
"""Title, colour and marker; from above to below where curves would coincide."""
_ROWS: Final = (
    ("balancing", "safe", "within the edges:\nsafe"),
    ("hazard", "safe", "past the hazard:\nsafe"),
    ("hazard", "both", "past the hazard:\nupright and safe"),
)
_COLUMNS: Final = (("wind", "wind"), ("torque", "torque"), ("corridor", "hazard"), ("noise", "noise"))
"""The axis of the first question and that of the second."""
_APART: Final = (0.09, 1.7)
"""Of one curve and the next: steps to the right, per cent downwards."""


def draw_sweeps(result: Mapping[str, Any], path: Path) -> None:
    """Shares with 95 % intervals over episodes."""
    sweeps = result["sweeps"]
    with figure(path, 6.6) as drawn:
        panels = drawn.subplots(len(_ROWS), len(_COLUMNS), sharey=True, squeeze=False)
        handles: dict[str, Any] = {}
        for line, (question, outcome, title) in zip(panels, _ROWS, strict=True):
            line[0].set_ylabel(title, fontsize=8.5)
            for axes, names in zip(line, _COLUMNS, strict=True):
                axis = sweeps.get(names[0 if question == "balancing" else 1])
                if axis is None:
                    axes.set_axis_off()
                else:
                    handles |= _panel(axes, axis, _pooled(axis[question]), outcome)
        ordered = [name for name in _LOOKS if name in handles]
        titles = [_LOOKS[name][0] for name in ordered]
        shapes = [handles[name] for name in ordered]
        drawn.legend(
            shapes,
            titles,
            loc="outside lower center",
            ncols=4,
            fontsize=8.5,
            title="bars: 95 % over episodes; curves stand a little apart, so that equal ones can be seen",
            title_fontsize=8,
        )
        heading(drawn, "Harder from left to right: where each method breaks")


def _pooled(rows: Mapping[str, Any]) -> dict[str, Any]:
    """With the four Fix as one, their episodes added up."""
    fixed = [row for name, row in rows.items() if name.startswith("fix_")]
    found = {name: dict(row) for name, row in rows.items() if not name.startswith("fix_")}
    if fixed:
        found["fix"] = {"episodes": sum(row["episodes"] for row in fixed)}
        for outcome in ("safe", "both"):
            if outcome in fixed[0]:
                found["fix"][outcome] = np.sum([row[outcome] for row in fixed], axis=0).tolist()
    return found


def _panel(axes: Axes, axis: Mapping[str, Any], rows: Mapping[str, Any], outcome: str) -> dict[str, Any]:
    """Each curve a little to the right of and below the one before, so that equal ones can be told apart."""
    places = np.arange(len(axis["shown"]), dtype=np.float64)
    present = [name for name in _LOOKS if name in rows]
    handles = {}
    for index, name in enumerate(present):
        _, colour, marker = _LOOKS[name]
        away = index - 0.5 * (len(present) - 1)
        low, share, high = _curve(rows[name][outcome], rows[name]["episodes"])
        middle = share - _APART[1] * away
        handles[name] = axes.errorbar(
            places + _APART[0] * away,
            middle,
            np.maximum(0.0, [share - low, high - share]),
            color=colour,
            marker=marker,
            markersize=3.6,
            linewidth=1.1,
            elinewidth=0.7,
        )
    axes.set_xticks(places, [f"{value:g}" for value in axis["shown"]])
    axes.set_xlim(-0.5, len(places) - 0.5)
    axes.set_ylim(-12, 112)
    axes.set_yticks([0, 50, 100], ["0 %", "50 %", "100 %"])
    axes.set_xlabel(axis["label"], fontsize=8)
    axes.tick_params(labelsize=7.5)
    bare(axes)
    return handles


def _curve(hits: Sequence[int], episodes: int) -> tuple[Any, Any, Any]:
    """Lower end, share and upper end [%]."""
    ends = np.array([wilson_interval(count, episodes) for count in hits])
    return 100.0 * ends[:, 0], 100.0 * np.array(hits) / episodes, 100.0 * ends[:, 1]
