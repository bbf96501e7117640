"""The car experiments as Markdown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from safedpa_lab.experiments.car.scenes import CONFIGURATIONS
from safedpa_lab.experiments.car.table import MEASURES, advantage_entry, share_with_interval, table_markdown
from safedpa_lab.experiments.report import markdown_table

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
