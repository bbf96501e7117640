"""The results of the car experiments: cells with 95 % Wilson intervals, comparisons, and their Markdown."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np

from safedpa.arrays import BoolArray
from safedpa_lab.experiments.car.conditions import CONFIGURATIONS, PERIOD
from safedpa_lab.experiments.car.episodes import Outcome
from safedpa_lab.experiments.car.methods import METHODS, Method
from safedpa_lab.experiments.common.statistics import holm, mcnemar_exact, wilson_interval
from safedpa_lab.experiments.report import markdown_table

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


MODEL_TITLES = {
    "car_learned": "tuned",
    "car_simulated": "untuned",
    "car_fix": "Fix",
    "car_mix": "Mix",
    "car": "physics model",
}
"""Models whose predictions are measured, in words."""


def markdown_of(result: dict[str, Any]) -> str:
    """The tables of a result: success and safety, prediction errors, latents, margins, as far as they were run."""
    first, last = result["seeds"]
    policies = f"Policies: {result['family']['phrase']}. " if "family" in result else ""
    parts = [f"{policies}Seeds of the episodes: {first} to {last}.\n"]
    if "cells" in result:
        parts.append(table_markdown(result["cells"]))
        parts += advantages_markdown(result.get("advantages", ()))
    if "equal_margin" in result:
        parts += _equal_margin_markdown(result["equal_margin"])
    if "errors" in result:
        parts.append(_errors_markdown(result))
    if "latent" in result:
        parts.append(_latent_markdown(result["latent"]))
    if "margin" in result:
        parts.append(margin_markdown(result["margin"]))
    parts += [f"{sentence}.\n" for sentence in result["left_out"]]
    return "\n".join(parts)


def advantages_markdown(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """SafeDPA against each other method, a table a measure, a column a place; nothing where there is no other."""
    if not rows:
        return []
    places = list(dict.fromkeys(row["place"] for row in rows))
    titles = [CONFIGURATIONS.get(place, place) for place in places]
    found = {(row["measure"], row["against"], row["place"]): row for row in rows}
    blocks = [
        "Episodes that went well with SafeDPA alone : with the other alone; p by McNemar's exact test, after Holm over "
        "all comparisons of this table; bold below 0.05.\n"
    ]
    for measure, phrase in MEASURES.items():
        lines = [f"| {phrase}: SafeDPA against | {' | '.join(titles)} |", "|---|" + "---|" * len(places)]
        for name, title in {row["against"]: row["title"] for row in rows if row["measure"] == measure}.items():
            entries = [advantage_entry(found[measure, name, place]) for place in places]
            lines.append(f"| {title} | {' | '.join(entries)} |")
        blocks += ["\n".join(lines) + "\n"] if len(lines) > 2 else []
    return blocks


def _equal_margin_markdown(result: Mapping[str, Any]) -> list[str]:
    kinds = ", ".join(f"{kind} {epsilon:.3f}" for kind, epsilon in result["epsilon"].items())
    blocks = [f"## With SafeDPA's own margin for every filter\n\nIn m, of the speed in m/s: {kinds}.\n"]
    return [*blocks, table_markdown(result["cells"]), *advantages_markdown(result["advantages"])]


def _errors_markdown(result: dict[str, Any]) -> str:
    loads = list(next(iter(result["errors"].values())))
    titles = [CONFIGURATIONS.get(load, load) for load in loads]
    blocks = []
    for horizon, phrase in (("one_step", "one step"), ("one_second", "one second")):
        lines = [f"| error over {phrase} | {' | '.join(titles)} |", "|---|" + "---|" * len(loads)]
        for name, rows in result["errors"].items():
            numbers = [f"{rows[load][horizon]['number']:.3g}" for load in loads]
            lines.append(f"| {MODEL_TITLES[name]} | {' | '.join(numbers)} |")
        if result.get("ratios"):
            ratios = [f"{result['ratios'][load][horizon]:.1f}" for load in loads]
            lines.append(f"| **untuned / tuned** | {' | '.join(ratios)} |")
        blocks.append("\n".join(lines))
    lines = ["| after one second | position [m] | yaw [rad] | speed [m/s] |", "|---|---|---|---|"]
    for name, rows in result["errors"].items():
        mixed = rows["mixed"]["one_second"]
        rms = mixed["root_mean_square"]
        lines.append(f"| {MODEL_TITLES[name]} | {mixed['position']:.3f} | {rms['yaw']:.3f} | {rms['speed']:.3f} |")
    return "\n\n".join([*blocks, "\n".join(lines)]) + "\n"


def _latent_markdown(latent: dict[str, Any]) -> str:
    cells = []
    for name, rows in latent.items():
        latents, errors = (rows["adaptation"][key] for key in ("latent_ticks", "error_ticks"))
        cells.append(
            f"{MODEL_TITLES[name]} | {100 * rows['accuracy']['share']:.0f} % "
            f"| {100 * rows['hitched_or_not']['share']:.0f} % | {_ticks(latents)} | {_ticks(errors)}"
        )
    return (
        markdown_table(
            "latent of | load right | hitched or not | change noticed: median ticks, within 50 | error back: the same",
            cells,
        )
        + "\n"
    )


def _ticks(row: dict[str, Any]) -> str:
    median = "never" if row["median"] is None else f"{row['median']:.0f}"
    return f"{median}, {row['within']}/{row['of']}"


def margin_markdown(margin: Mapping[str, Any]) -> str:
    """The margin of each filter's model, and what it covered on fresh drives."""
    lines = [
        "| margin: conformal, (theorem) | obstacle [m] | field [m] | speed [m/s] | steps covered on fresh drives |",
        "|---|---|---|---|---|",
    ]
    for name, kinds in margin["models"].items():
        cells = [_epsilons(kinds[kind]) if kind in kinds else "-" for kind in ("obstacle", "field", "speed")]
        covered = ", ".join(f"{100 * row['conformal']['share']:.1f} %" for row in kinds.values())
        lines.append(f"| {MODEL_TITLES.get(name, name)} | {' | '.join(cells)} | {covered} |")
    loads = ", ".join(margin.get("calibrated_with", ()))
    reported = f"Used by every filter: {margin['used']}{f', calibrated with {loads}' if loads else ''}."
    return "\n".join([*lines, "", reported]) + "\n"


def _epsilons(row: dict[str, Any]) -> str:
    return f"{row['conformal']['epsilon']:.3f} ({row['theorem']['epsilon']:.3f})"


def curves_markdown(result: Mapping[str, Any]) -> str:
    """Of each sweep the shares with their 95 % intervals, then SafeDPA against each other method; at last margins."""
    first, last = result["seeds"]
    parts = [
        "# The car, made harder",
        f"Policies: {result['family']['phrase']}. Seeds of the scenes: {first} to {last}, the same for every method "
        f"and value. It tows a {result['load']} where the sweep is not about the load. Shares with 95 % Wilson "
        "intervals. Margins are those of the experiment, at every value.",
    ]
    for sweep in result["sweeps"].values():
        parts += [f"## {sweep['label'][0].upper()}{sweep['label'][1:]}", _shares(sweep), *_changes(sweep)]
        parts += _significance(sweep)
    parts += ["## Margins", margin_markdown(result["margin"]).rstrip()]
    parts += [f"{sentence}." for sentence in result["left_out"]]
    return "\n\n".join(parts) + "\n"


def _shares(sweep: Mapping[str, Any]) -> str:
    shown = sweep["shown"]
    found = {(point["method"], point["shown"]): point for point in sweep["points"]}
    lines = [f"| {sweep['label']} | | {' | '.join(shown)} |", "|---|---|" + "---|" * len(shown)]
    for name in dict.fromkeys(point["method"] for point in sweep["points"]):
        for measure, phrase in MEASURES.items():
            entries = [share_with_interval(found[name, value][measure]) for value in shown]
            lines.append(f"| {found[name, shown[0]]['title']} | {phrase} | {' | '.join(entries)} |")
    return "\n".join(lines)


def _changes(sweep: Mapping[str, Any]) -> list[str]:
    """How often the load was hitched or released while driving, in the sweeps that request it."""
    changed: dict[str, list[str]] = {}
    for point in sweep["points"]:
        if point["load_changed"]:
            reported = f"{point['title']} {point['load_changed']} of {point['episodes']}"
            changed.setdefault(point["shown"], []).append(reported)
    return [f"Hitched {shown}, done in: {', '.join(phrase)}." for shown, phrase in changed.items()]


def _significance(sweep: Mapping[str, Any]) -> list[str]:
    rows: Sequence[Mapping[str, Any]] = sweep["advantages"]
    if not rows:
        return []
    found = {(row["against"], row["measure"], row["place"]): row for row in rows}
    shown = sweep["shown"]
    lines = [f"| SafeDPA against | | {' | '.join(shown)} |", "|---|---|" + "---|" * len(shown)]
    for name, measure in dict.fromkeys((row["against"], row["measure"]) for row in rows):
        entries = [advantage_entry(found[name, measure, value]) for value in shown]
        lines.append(f"| {found[name, measure, shown[0]]['title']} | {MEASURES[measure]} | {' | '.join(entries)} |")
    reported = (
        "Episodes that went well with SafeDPA alone : with the other alone; p by McNemar's exact test, after Holm over "
        "all comparisons of this sweep; bold below 0.05."
    )
    return [reported, "\n".join(lines)]
