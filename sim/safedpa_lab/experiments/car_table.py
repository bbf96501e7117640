"""The table of the car experiment: success, safety, both together, with 95 % Wilson intervals."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from safedpa_lab.experiments.car_conditions import PERIOD
from safedpa_lab.experiments.car_episodes import Outcome
from safedpa_lab.experiments.car_methods import METHODS, Method
from safedpa_lab.experiments.car_scenes import CONFIGURATIONS
from safedpa_lab.experiments.statistics import wilson_interval

__all__ = ["MEASURES", "PAPER", "cell_of", "share_with_interval", "table_markdown"]

MEASURES = {"success": "success", "safe": "safety", "both": "both"}
"""Key of a cell and its word: goal reached in time; no contact; goal reached without any contact."""

PAPER: dict[str, dict[str, dict[str, float]]] = {
    "safedpa": {
        "box": {"success": 1.00, "safe": 0.90},
        "chair": {"success": 0.80, "safe": 1.00},
        "none": {"success": 1.00, "safe": 0.75},
    }
}
"""What the paper states of its car, by method and configuration. Source: Xiao, He, Dolan, Shi, Safe Deep Policy
Adaptation, ICRA 2024. It counts a success whatever happened on the way, and has no large chair."""


def cell_of(method: Method, load: str, outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """One cell: shares with intervals, time to the goal, how often the filter changed the nominal action, what was touched."""
    ticks = sum(item.ticks for item in outcomes)
    statuses: Counter[str] = Counter()
    for item in outcomes:
        statuses.update(item.statuses)
    reached = [item.ticks * PERIOD for item in outcomes if item.success]
    return {
        "method": method.name,
        "title": method.title,
        "load": load,
        "configuration": CONFIGURATIONS.get(load, load),
        "episodes": len(outcomes),
        "success": _share([item.success for item in outcomes]),
        "safe": _share([item.safe for item in outcomes]),
        "both": _share([item.success and item.safe for item in outcomes]),
        "seconds_to_goal": round(float(np.median(reached)), 3) if reached else None,
        "changed_share": round(sum(item.changed for item in outcomes) / ticks, 4),
        "statuses": dict(sorted(statuses.items())),
        "covered": _covered(outcomes),
        "least_h": min(item.least_h for item in outcomes),
        "not_reached": [item.seed for item in outcomes if not item.success],
        "not_safe": [item.seed for item in outcomes if not item.safe],
        "paper": PAPER.get(method.name, {}).get(load),
    }


def table_markdown(cells: Sequence[dict[str, Any]]) -> str:
    """The table in Markdown, a row a method, a column a configuration: success / safety / both in each cell."""
    loads = [load for load in CONFIGURATIONS if any(cell["load"] == load for cell in cells)]
    titles = [CONFIGURATIONS[load] for load in loads]
    lines = [f"| success / safety / both | {' | '.join(titles)} |", "|---|" + "---|" * len(loads)]
    for name in (name for name in METHODS if any(cell["method"] == name for cell in cells)):
        found = {cell["load"]: cell for cell in cells if cell["method"] == name}
        row = [_entry(found[load]) if load in found else "" for load in loads]
        lines.append(f"| {METHODS[name].title} | {' | '.join(row)} |")
    lines.append(f"| *the paper's SafeDPA* | {' | '.join(_paper_entry(load) for load in loads)} |")
    return "\n".join([*lines, "", *_interval_lines(cells)]) + "\n"


def _interval_lines(cells: Sequence[dict[str, Any]]) -> list[str]:
    lines = [
        "| method | configuration | episodes | success [95 %] | safety [95 %] | both [95 %] | s to goal | changed |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for cell in cells:
        shares = " | ".join(share_with_interval(cell[key]) for key in MEASURES)
        seconds = "-" if cell["seconds_to_goal"] is None else f"{cell['seconds_to_goal']:.1f}"
        lines.append(
            f"| {cell['title']} | {cell['configuration']} | {cell['episodes']} | {shares} | {seconds} "
            f"| {100 * cell['changed_share']:.0f} % |"
        )
    return lines


def _entry(cell: dict[str, Any]) -> str:
    return " / ".join(f"{cell[key]['share']:.2f}" for key in MEASURES)


def _paper_entry(load: str) -> str:
    values = PAPER["safedpa"].get(load)
    return "-" if values is None else f"{values['success']:.2f} / {values['safe']:.2f} / -"


def share_with_interval(share: Mapping[str, Any]) -> str:
    """As it stands in a table."""
    low, high = share["interval_95"]
    return f"{share['share']:.2f} [{low:.2f}, {high:.2f}]"


def _covered(outcomes: Sequence[Outcome]) -> dict[str, dict[str, Any]]:
    """By kind of barrier: the share of the episodes' steps whose error the calibrated margin covered."""
    kinds = dict.fromkeys(kind for item in outcomes for kind in item.covered)
    return {
        kind: {"covered": covered, "steps": steps, "share": round(covered / steps, 5)}
        for kind in kinds
        for covered, steps in [
            np.sum([item.covered[kind] for item in outcomes if kind in item.covered], axis=0).tolist()
        ]
    }


def _share(hits: Sequence[bool]) -> dict[str, Any]:
    count = sum(hits)
    interval = [round(end, 4) for end in wilson_interval(count, len(hits))]
    return {"hits": count, "of": len(hits), "share": round(count / len(hits), 4), "interval_95": interval}
