"""What the point robot's baselines learned: a table next to the published figures, learning curves as a picture."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from safedpa_lab.experiments.common.figures import BLACK, GREY, bare, figure, heading
from safedpa_lab.point.baseline_set import PUBLISHED, TASKS
from safedpa_lab.point.methods import BASELINE_TITLES
from safedpa_lab.point.plan import BASELINES, LIMITED
from safedpa_lab.provenance.record import write_result

if TYPE_CHECKING:
    from matplotlib.axes import Axes


_COLOURS = {
    "ppo": "#D55E00",
    "trpo": "#E69F00",
    "ppo_lagrangian": "#009E73",
    "trpo_lagrangian": "#56B4E9",
    "cpo": "#CC79A7",
}
_LIMIT = 25.0


def write_baselines(found: dict[str, dict[str, Any]], out: Path) -> None:
    """``baselines.json``, ``baselines.md`` and ``baselines.png`` in the folder, of accounts by NAME_TASK."""
    out.mkdir(parents=True, exist_ok=True)
    write_result(out / "baselines.json", found)
    (out / "baselines.md").write_text(markdown_of(found), encoding="utf-8")
    _draw(found, out / "baselines.png")


def markdown_of(found: dict[str, dict[str, Any]]) -> str:
    """One line a baseline: reward and cost of an episode in still air, as published, and in winds; then all others."""
    lines = [
        "| reward / cost of an episode of 1000 steps | still air | published, 10 million steps | in winds "
        "| steps, million | processor, min |",
        "|---|---|---|---|---|---|",
    ]
    for name in BASELINES:
        rows = [found.get(f"{name}_{task}") for task in TASKS]
        reported = [f"{row['reward']:.1f} / {row['cost']:.1f}" if row else "" for row in rows]
        known = [row for row in rows if row]
        steps = ", ".join(sorted({f"{row['plan']['steps'] / 1e6:g}" for row in known}))
        minutes = ", ".join(f"{row['processor_seconds'] / 60:.1f}" for row in known)
        reward, cost = PUBLISHED[name]
        published = f"{reward:.1f} / {cost:.1f}"
        lines.append(f"| {BASELINE_TITLES[name]} | {reported[0]} | {published} | {reported[1]} | {steps} | {minutes} |")
    others = {
        key: row for key, row in found.items() if key not in {f"{name}_{task}" for name in BASELINES for task in TASKS}
    }
    return "\n".join([*lines, *(("", *_others(others)) if others else ())]) + "\n"


def _others(found: dict[str, dict[str, Any]]) -> list[str]:
    """One line for each that was trained with other inputs, or for another limit."""
    lines = [
        "| trained | inputs | limit | reward | cost | goals | multiplier | kept, million steps | of | seed |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for key, row in found.items():
        plan = row["plan"]
        reported = f"{row['reward']:.1f} | {row['cost']:.1f} | {row['goals']:.1f} | {row['multiplier']:.2f}"
        retained = f"{row['chosen']['steps'] / 1e6:.2f} | {plan['steps'] / 1e6:g}"
        limit = f"{plan['limit']:g}" if plan["name"] in LIMITED else ""
        lines.append(f"| {key} | {plan['inputs']} | {limit} | {reported} | {retained} | {plan['seed']} |")
    return lines


def _draw(found: dict[str, dict[str, Any]], path: Path) -> None:
    with figure(path, 4.8) as drawn:
        panels = drawn.subplots(2, 2, sharex=True, sharey="row")
        for column, (task, title) in enumerate((("still", "still air"), ("wind", "winds up to 0.008 N"))):
            _curves(panels[0, column], found, task, 1)
            _curves(panels[1, column], found, task, 2)
            panels[0, column].set_title(title, fontsize=9.5, color=BLACK)
            panels[1, column].axhline(_LIMIT, color=GREY, linestyle=":", linewidth=1)
            panels[1, column].set_xlabel("million steps")
        panels[0, 0].set_ylabel("reward of an episode")
        panels[1, 0].set_ylabel("cost of an episode")
        panels[1, 0].set_ylim(0, 100)
        panels[0, 0].legend(fontsize=8, loc="lower right")
        heading(drawn, "What the baselines learned", "means of the last 200 episodes; dotted: the limit on the cost")


def _curves(axes: Axes, found: dict[str, dict[str, Any]], task: str, entry: int) -> None:
    for name in BASELINES:
        if (row := found.get(f"{name}_{task}")) is not None:
            curve = row["learning_curve"]
            steps, values = [point[0] / 1e6 for point in curve], [point[entry] for point in curve]
            axes.plot(steps, values, color=_COLOURS[name], linewidth=1.5, label=BASELINE_TITLES[name])
    bare(axes)
