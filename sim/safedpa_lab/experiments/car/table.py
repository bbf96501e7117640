"""The table of the car experiment: success, safety, both together, with 95 % Wilson intervals."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np

from safedpa.arrays import BoolArray
from safedpa_lab.experiments.car.conditions import PERIOD
from safedpa_lab.experiments.car.episodes import Outcome
from safedpa_lab.experiments.car.methods import METHODS, Method
from safedpa_lab.experiments.car.scenes import CONFIGURATIONS
from safedpa_lab.experiments.common.statistics import holm, mcnemar_exact, wilson_interval

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
Adaptation, ICRA 2024. It counts a success even after contacts, and has no large chair."""


def cell_of(method: Method, load: str, outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """One cell: shares with intervals, time to the goal, share of changed actions, contacts."""
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
    """Share and interval as shown in a table."""
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


OWN: Final = "safedpa"
"""The method that is compared with every other one."""
SIGNIFICANT: Final = 0.05
"""Of a p by Holm's method."""

Outcomes = Mapping[str, Sequence[Outcome]]
"""By method, of the same scenes in the same order."""


def advantages(places: Mapping[str, Outcomes], measures: Sequence[str] = tuple(MEASURES)) -> list[dict[str, Any]]:
    """SafeDPA against every other method in each place, by measure: a row each; none where SafeDPA is not driven.

    ``places`` by name, such as a configuration or a value. Episodes are paired by scene: ``only_safedpa`` are those
    that went well with it alone, ``only_other`` those that did with the other alone, ``mcnemar`` the exact two-sided p
    of their being as many, ``holm`` the same as it stands next to all rows.
    """
    rows = [row for place, outcomes in places.items() for row in _rows(place, outcomes, measures)]
    for row, p in zip(rows, holm([row["mcnemar"] for row in rows]), strict=True):
        row["holm"] = p
    return rows


def _rows(place: str, outcomes: Outcomes, measures: Sequence[str]) -> Iterator[dict[str, Any]]:
    if OWN not in outcomes:
        return
    for name, other in outcomes.items():
        for measure in measures if name != OWN else ():
            more, fewer, p = mcnemar_exact(_flags(outcomes[OWN], measure), _flags(other, measure))
            reported = {"place": place, "against": name, "title": METHODS[name].title, "measure": measure}
            yield {**reported, "episodes": len(other), "only_safedpa": more, "only_other": fewer, "mcnemar": p}


def _flags(outcomes: Sequence[Outcome], measure: str) -> BoolArray:
    """(episodes,) whether each went well."""
    return np.array([_went_well(item, measure) for item in outcomes], dtype=bool)


def _went_well(item: Outcome, measure: str) -> bool:
    return {"success": item.success, "safe": item.safe, "both": item.success and item.safe}[measure]


def advantage_entry(row: Mapping[str, Any]) -> str:
    """A table cell: episodes that succeeded with SafeDPA only, with the other only, and Holm's p.

    Bold where the p is below ``SIGNIFICANT``; a minus where neither ever went well alone.
    """
    more, fewer, p = row["only_safedpa"], row["only_other"], row["holm"]
    if not more + fewer:
        return "-"
    reported = f"{more} : {fewer}, p = {p:.2g}"
    return f"**{reported}**" if p < SIGNIFICANT else reported
