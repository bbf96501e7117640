"""The results of the car experiments: cells with 95 % Wilson intervals, comparisons, and their Markdown."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np

from safedpa.arrays import BoolArray
from safedpa_lab.experiments.car.conditions import CONFIGURATIONS, PERIOD
from safedpa_lab.experiments.car.episodes import Outcome
from safedpa_lab.experiments.car.methods import METHODS, Method
from safedpa_lab.experiments.common.drives import statuses_of
from safedpa_lab.experiments.common.statistics import holm, mcnemar_exact, share_95
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
        "statuses": statuses_of(item.statuses for item in outcomes),
        "covered": _covered(outcomes),
        "least_h": min(item.least_h for item in outcomes),
        "not_reached": [item.seed for item in outcomes if not item.success],
        "not_safe": [item.seed for item in outcomes if not item.safe],
        "paper": PAPER.get(method.name, {}).get(load),
    }


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
    count, size = sum(hits), len(hits)
    return {"hits": count, "of": size, "share": round(count / size, 4), "interval_95": share_95(count, size)}


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
    success, safe = np.array([[item.success, item.safe] for item in outcomes], dtype=bool).T
    flags: dict[str, BoolArray] = {"success": success, "safe": safe, "both": success & safe}
    return flags[measure]


def markdown_of(result: dict[str, Any]) -> str:
    """The tables of a result: success and safety, prediction errors, latents, margins, as far as they were run."""
    first, last = result["seeds"]
    policies = f"Policies: {result['family']['phrase']}. " if "family" in result else ""
    blocks = [f"{policies}Seeds of the episodes: {first} to {last}."]
    if "cells" in result:
        blocks += [table_markdown(result["cells"]), *_advantages_by_measure(result.get("advantages", ()))]
    if "equal_margin" in result:
        equal = result["equal_margin"]
        kinds = ", ".join(f"{kind} {epsilon:.3f}" for kind, epsilon in equal["epsilon"].items())
        blocks.append(f"## With SafeDPA's own margin for every filter\n\nIn m, of the speed in m/s: {kinds}.")
        blocks += [table_markdown(equal["cells"]), *_advantages_by_measure(equal["advantages"])]
    if "errors" in result:
        blocks += _errors_markdown(result["errors"], result.get("ratios"))
    if "latent" in result:
        blocks.append(_latent_markdown(result["latent"]))
    if "margin" in result:
        blocks += _margin_markdown(result["margin"])
    return "\n\n".join([*blocks, *(f"{sentence}." for sentence in result["left_out"])]) + "\n"


def table_markdown(cells: Sequence[dict[str, Any]]) -> str:
    """The table in Markdown, a row a method, a column a configuration: success / safety / both in each cell."""
    loads = [load for load in CONFIGURATIONS if any(cell["load"] == load for cell in cells)]
    rows = []
    for name in (name for name in METHODS if any(cell["method"] == name for cell in cells)):
        found = {cell["load"]: cell for cell in cells if cell["method"] == name}
        shares = ([f"{found[load][key]['share']:.2f}" for key in MEASURES] if load in found else [] for load in loads)
        rows.append(" | ".join([METHODS[name].title, *map(" / ".join, shares)]))
    paper = [PAPER["safedpa"].get(load) for load in loads]
    shown = [f"{own['success']:.2f} / {own['safe']:.2f} / -" if own else "-" for own in paper]
    rows.append(" | ".join(["*the paper's SafeDPA*", *shown]))
    titles = [CONFIGURATIONS[load] for load in loads]
    intervals = markdown_table(
        "method | configuration | episodes | success [95 %] | safety [95 %] | both [95 %] | s to goal | changed",
        map(_intervals, cells),
    )
    return "\n\n".join([markdown_table(" | ".join(["success / safety / both", *titles]), rows), intervals])


def _intervals(cell: dict[str, Any]) -> str:
    shares = " | ".join(_with_interval(cell[key]) for key in MEASURES)
    seconds = "-" if cell["seconds_to_goal"] is None else f"{cell['seconds_to_goal']:.1f}"
    place = f"{cell['title']} | {cell['configuration']} | {cell['episodes']}"
    return f"{place} | {shares} | {seconds} | {100 * cell['changed_share']:.0f} %"


def _with_interval(share: Mapping[str, Any]) -> str:
    low, high = share["interval_95"]
    return f"{share['share']:.2f} [{low:.2f}, {high:.2f}]"


_ALONE = (
    "Episodes that went well with SafeDPA alone : with the other alone; p by McNemar's exact test, after Holm over all "
    "comparisons of this {}; bold below 0.05."
)


def _advantages_by_measure(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """SafeDPA against each other method, a table a measure, a column a place; nothing where there is no other."""
    places = list(dict.fromkeys(row["place"] for row in rows))
    titles = [CONFIGURATIONS.get(place, place) for place in places]
    found = {(row["measure"], row["against"], row["place"]): row for row in rows}
    tables = []
    for measure, phrase in MEASURES.items():
        others = {row["against"]: row["title"] for row in rows if row["measure"] == measure}
        lines = [
            " | ".join([title, *(_advantage(found[measure, name, place]) for place in places)])
            for name, title in others.items()
        ]
        if lines:
            tables.append(markdown_table(" | ".join([f"{phrase}: SafeDPA against", *titles]), lines))
    return [_ALONE.format("table"), *tables] if rows else []


def _advantage(row: Mapping[str, Any]) -> str:
    """Episodes that succeeded with SafeDPA only, with the other only, and Holm's p.

    Bold where the p is below ``SIGNIFICANT``; a minus where neither ever went well alone.
    """
    more, fewer, p = row["only_safedpa"], row["only_other"], row["holm"]
    reported = f"{more} : {fewer}, p = {p:.2g}" if more + fewer else "-"
    return f"**{reported}**" if more + fewer and p < SIGNIFICANT else reported


MODEL_TITLES = {
    "car_learned": "tuned",
    "car_simulated": "untuned",
    "car_fix": "Fix",
    "car_mix": "Mix",
    "car": "physics model",
}
"""Models whose predictions are measured, in words."""


def _errors_markdown(errors: Mapping[str, Any], ratios: Mapping[str, Any] | None) -> list[str]:
    loads = list(next(iter(errors.values())))
    titles = [CONFIGURATIONS.get(load, load) for load in loads]
    blocks = []
    for horizon, phrase in (("one_step", "one step"), ("one_second", "one second")):
        lines = [
            " | ".join([MODEL_TITLES[name], *(f"{rows[load][horizon]['number']:.3g}" for load in loads)])
            for name, rows in errors.items()
        ]
        if ratios:
            lines.append(" | ".join(["**untuned / tuned**", *(f"{ratios[load][horizon]:.1f}" for load in loads)]))
        blocks.append(markdown_table(" | ".join([f"error over {phrase}", *titles]), lines))
    lines = []
    for name, rows in errors.items():
        mixed = rows["mixed"]["one_second"]
        rms = mixed["root_mean_square"]
        lines.append(f"{MODEL_TITLES[name]} | {mixed['position']:.3f} | {rms['yaw']:.3f} | {rms['speed']:.3f}")
    return [*blocks, markdown_table("after one second | position [m] | yaw [rad] | speed [m/s]", lines)]


def _latent_markdown(latent: dict[str, Any]) -> str:
    cells = []
    for name, rows in latent.items():
        latents, errors = (rows["adaptation"][key] for key in ("latent_ticks", "error_ticks"))
        cells.append(
            f"{MODEL_TITLES[name]} | {100 * rows['accuracy']['share']:.0f} % "
            f"| {100 * rows['hitched_or_not']['share']:.0f} % | {_ticks(latents)} | {_ticks(errors)}"
        )
    return markdown_table(
        "latent of | load right | hitched or not | change noticed: median ticks, within 50 | error back: the same",
        cells,
    )


def _ticks(row: dict[str, Any]) -> str:
    median = "never" if row["median"] is None else f"{row['median']:.0f}"
    return f"{median}, {row['within']}/{row['of']}"


def _margin_markdown(margin: Mapping[str, Any]) -> list[str]:
    """The margin of each filter's model, and what it covered on fresh drives."""
    lines = []
    for name, kinds in margin["models"].items():
        found = [kinds.get(kind) for kind in ("obstacle", "field", "speed")]
        cells = [f"{of['conformal']['epsilon']:.3f} ({of['theorem']['epsilon']:.3f})" if of else "-" for of in found]
        covered = ", ".join(f"{100 * row['conformal']['share']:.1f} %" for row in kinds.values())
        lines.append(" | ".join([MODEL_TITLES.get(name, name), *cells, covered]))
    loads = ", ".join(margin.get("calibrated_with", ()))
    head = "margin: conformal, (theorem) | obstacle [m] | field [m] | speed [m/s] | steps covered on fresh drives"
    reported = f"Used by every filter: {margin['used']}{f', calibrated with {loads}' if loads else ''}."
    return [markdown_table(head, lines), reported]


def curves_markdown(result: Mapping[str, Any]) -> str:
    """Of each sweep the shares with their 95 % intervals, then SafeDPA against each other method; at last margins."""
    first, last = result["seeds"]
    blocks = [
        "# The car, made harder",
        f"Policies: {result['family']['phrase']}. Seeds of the scenes: {first} to {last}, the same for every method "
        f"and value. It tows a {result['load']} where the sweep is not about the load. Shares with 95 % Wilson "
        "intervals. Margins are those of the experiment, at every value.",
    ]
    for sweep in result["sweeps"].values():
        blocks += [f"## {sweep['label'][0].upper()}{sweep['label'][1:]}", _shares(sweep), *_changes(sweep)]
        if rows := sweep["advantages"]:
            found = {(row["against"], row["measure"], row["place"]): row for row in rows}
            lines = [
                f"{row['title']} | {MEASURES[row['measure']]} | "
                + " | ".join(_advantage(found[row["against"], row["measure"], value]) for value in sweep["shown"])
                for row in rows
                if row["place"] == sweep["shown"][0]
            ]
            blocks += [
                _ALONE.format("sweep"),
                markdown_table(" | ".join(["SafeDPA against |", *sweep["shown"]]), lines),
            ]
    blocks += ["## Margins", *_margin_markdown(result["margin"])]
    return "\n\n".join([*blocks, *(f"{sentence}." for sentence in result["left_out"])]) + "\n"


def _shares(sweep: Mapping[str, Any]) -> str:
    shown = sweep["shown"]
    found = {(point["method"], point["shown"]): point for point in sweep["points"]}
    lines = [
        " | ".join(
            [found[name, shown[0]]["title"], phrase, *(_with_interval(found[name, at][measure]) for at in shown)]
        )
        for name in dict.fromkeys(point["method"] for point in sweep["points"])
        for measure, phrase in MEASURES.items()
    ]
    return markdown_table(" | ".join([f"{sweep['label']} |", *shown]), lines)


def _changes(sweep: Mapping[str, Any]) -> list[str]:
    """How often the load was hitched or released while driving, in the sweeps that request it."""
    changed: dict[str, list[str]] = {}
    for point in sweep["points"]:
        if point["load_changed"]:
            reported = f"{point['title']} {point['load_changed']} of {point['episodes']}"
            changed.setdefault(point["shown"], []).append(reported)
    return [f"Hitched {shown}, done in: {', '.join(phrase)}." for shown, phrase in changed.items()]
