"""The point robot that goes on learning, as Markdown, JSON and one picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa_lab.experiments.car_style import BLACK, BLUE, GREY, RED, bare, figure, heading
from safedpa_lab.experiments.point_learning import BEHIND
from safedpa_lab.point.online_learning import STARTS, WARMING
from safedpa_lab.provenance.record import write_result

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["driven_table", "judged_table", "learning_markdown", "per_thousand", "smoothed", "write_learning"]

Rows = Sequence[Mapping[str, Any]]

_COLOURS: Final = {"filter": BLUE, "none": RED}
_PANELS: Final = {"goals": "goals in 1000 steps", "unsafe": "unsafe steps in 1000"}
_PARTS: Final = 5
"""The first and the last of so many parts of the steps stand in the table."""
_SMOOTHED: Final = 5
"""Rows over which a drawn curve is the mean."""


def write_learning(result: dict[str, Any], out: Path) -> None:
    """``point-learning.json``, ``point-learning.md`` and ``point_learning.png`` in the folder."""
    out.mkdir(parents=True, exist_ok=True)
    write_result(out / "point-learning.json", result)
    (out / "point-learning.md").write_text(learning_markdown(result), encoding="utf-8")
    _picture(result, out / "point_learning.png")


def learning_markdown(result: Mapping[str, Any]) -> str:
    """What was run, the steps of learning, and the policies before and after."""
    head = (
        f"Training seeds {_seeds(result)}, {result['robots']} robots each, wind {1e3 * result['force']:g} mN, "
        f"margin {1e3 * result['margin']:.2f} mm, seed {result['seed']} (evaluation "
        f"{' and '.join(map(str, result['evaluation_seeds']))}), {result['date']}."
    )
    parts = [head, "## While learning", driven_table(result), "## Before and after", judged_table(result)]
    return "\n\n".join(parts) + "\n"


def driven_table(result: Mapping[str, Any]) -> str:
    """All steps of the learning of all training seeds together; in the first and in the last fifth of them."""
    lines = [
        "| start | behind | steps | unsafe steps | in 1000 | episodes without cost | goals in 1000 steps, first fifth "
        "| last fifth | return, first | last | changed by the filter, %, first | last |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for start, behind, row in _each(result):
        goals, gained, changed = (_ends(row["rows"], name) for name in ("goals", "reward", "corrected"))
        safe = f"{row['safe_episodes']:.0f} of {row['episodes']:.0f}"
        reported = [f"{value:.1f}" for value in (*goals, *gained)]
        reported += [f"{value / 10:.1f}" if behind == "filter" else "" for value in changed]
        lines.append(
            f"| {STARTS[start].title} | {BEHIND[behind]} | {row['steps']:,} | {row['unsafe']:.0f} "
            f"| {1e3 * row['unsafe'] / row['steps']:.2f} | {safe} | {' | '.join(reported)} |"
        )
    return "\n".join(lines)


def judged_table(result: Mapping[str, Any]) -> str:
    """Whole episodes without noise of the policy as it began, and of those that came of it, by training seed."""
    lines = [
        "| start | behind | learned | goals | episodes without cost | unsafe steps | changed by the filter, % |",
        "|---|---|---|---|---|---|---|",
    ]
    for start, behind, row in _each(result):
        before = {"nothing yet": row["judged_before"]} if row["judged_before"] else {}
        for name, judged in {**before, **{f"seed {seed}": one for seed, one in row["judged"].items()}}.items():
            mean, low, high = judged["goals"]
            changed = f"{100 * judged['corrected']:.1f}" if behind == "filter" else ""
            lines.append(
                f"| {STARTS[start].title} | {BEHIND[behind]} | {name} | {mean:.1f} ({low:.1f} to {high:.1f}) "
                f"| {judged['safe']} of {judged['episodes']} | {judged['unsafe_steps']} | {changed} |"
            )
    return "\n".join(lines)


def per_thousand(rows: Rows, name: str) -> tuple[FloatArray, FloatArray]:
    """Steps at the middle of each row, and the row's count of ``name`` in 1000 steps."""
    ends = np.array([0, *(row["steps"] for row in rows)], dtype=np.float64)
    counts = np.array([row[name] for row in rows], dtype=np.float64)
    return 0.5 * (ends[:-1] + ends[1:]), 1e3 * counts / np.diff(ends)


def smoothed(values: FloatArray, over: int = _SMOOTHED) -> FloatArray:
    """The mean of each value and its neighbours, ``over`` of them where there are as many on both sides."""
    half = over // 2
    means = [values[max(0, place - half) : place + half + 1].mean() for place in range(len(values))]
    return np.array(means, dtype=np.float64)


def _seeds(result: Mapping[str, Any]) -> str:
    return ", ".join(map(str, result["seeds"]))


def _each(result: Mapping[str, Any]) -> list[tuple[str, str, Mapping[str, Any]]]:
    return [(start, behind, row) for start, found in result["starts"].items() for behind, row in found.items()]


def _ends(by_seed: Mapping[str, Rows], name: str) -> tuple[float, float]:
    """In 1000 steps, over the first and over the last fifth of each seed's rows."""
    first, last = [], []
    for rows in by_seed.values():
        each, count = per_thousand(rows, name)[1], max(1, len(rows) // _PARTS)
        first.append(each[:count].mean())
        last.append(each[-count:].mean())
    return float(np.mean(first)), float(np.mean(last))


def _picture(result: Mapping[str, Any], path: Path) -> None:
    """A column for each start; above the goals, below the unsafe steps."""
    starts = result["starts"]
    with figure(path, 4.9) as drawn:
        panels = drawn.subplots(2, len(starts), sharex=True, sharey="row", squeeze=False)
        for column, (start, found) in enumerate(starts.items()):
            for axes, (name, title) in zip(panels[:, column], _PANELS.items(), strict=True):
                for behind, row in found.items():
                    _curves(axes, row["rows"], name, behind)
                if STARTS[start].key:
                    axes.axvspan(0, WARMING / 1e3, color=GREY, alpha=0.12, linewidth=0)
                axes.set_ylim(bottom=-0.025 * axes.get_ylim()[1])  # so that a curve of nothing is seen whole
                bare(axes)
                if column == 0:
                    axes.set_ylabel(title)
            panels[0, column].set_title(STARTS[start].title, fontsize=9.5, color=BLACK, loc="left")
            panels[1, column].set_xlabel("thousand steps of learning")
        panels[0, 0].legend(fontsize=8.5, loc="upper left")
        heading(
            drawn,
            "A policy that goes on learning, with the filter and without",
            f"training seeds {_seeds(result)} (thin) and their mean, over {_SMOOTHED} updates; grey: only the critic "
            "learns",
        )


def _curves(axes: Axes, by_seed: Mapping[str, Rows], name: str, behind: str) -> None:
    curves = []
    for rows in by_seed.values():
        steps, values = per_thousand(rows, name)
        curves.append(smoothed(values))
        axes.plot(steps / 1e3, curves[-1], color=_COLOURS[behind], linewidth=0.8, alpha=0.4)
    axes.plot(steps / 1e3, np.mean(curves, axis=0), color=_COLOURS[behind], linewidth=2.2, label=BEHIND[behind])
