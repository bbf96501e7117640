"""The pendulum experiment as Markdown, JSON and pictures."""

from __future__ import annotations

from collections.abc import Mapping
from math import degrees
from typing import Any, Final

from safedpa.safety import MarginCalibration
from safedpa_lab.experiments.pendulum.episodes import BEST_PENALTY
from safedpa_lab.experiments.report import markdown_table, percent

_TABLES: Final = {"own": "each filter its own margin", "same": "SafeDPA's margin for all"}
_OUTCOMES: Final = {"safe": "safe", "success": "upright", "both": "both"}


def without_points(result: dict[str, Any]) -> dict[str, Any]:
    """The result without the points that only the figures need."""
    tables = {
        table: {
            question: {name: {key: row[key] for key in row if key != "shown"} for name, row in rows.items()}
            for question, rows in questions.items()
        }
        for table, questions in result["tables"].items()
    }
    latent = {
        name: {key: value for key, value in row.items() if key not in ("latents", "refined", "directions")}
        for name, row in result["latent"].items()
    }
    return {**result, "tables": tables, "latent": latent}


def calibration_of(result: dict[str, Any]) -> MarginCalibration:
    """The margin of SafeDPA's learned model, as the filter reads it."""
    margin = result["margins"]["safedpa"]
    return MarginCalibration(
        epsilon={"corridor": margin["epsilon"]},
        coverage=margin["coverage"],
        transitions=margin["transitions"],
        date=result["date"],
        fingerprint=margin["fingerprint"],
        covered={"conformal.corridor": result["tables"]["own"]["balancing"]["safedpa"]["covered"]},
        drives=margin["drives"],
    )


def markdown_of(result: Mapping[str, Any]) -> str:
    """Both questions as tables, then significance, margins, what is harder, invariance and latent."""
    head = f"{result['directions']} wind directions x {result['episodes']} episodes, evaluation seed {result['seed']}"
    parts = [f"{head}, {result['date']}." if result["date"] else f"{head}."]
    for table, title in _TABLES.items():
        parts += [f"## With {title}", balancing_table(result, table), hazard_table(result, table)]
        parts.append(advantages_table(result, table))
    largest, wind = result["invariance"]["largest_wind"], result["assumed"]["wind"]
    parts += ["## Margins", margins_table(result), "## RMA-P", penalties_table(result)]
    if result["sweeps"]:
        parts += ["## Harder and easier", sweeps_table(result)]
    parts += [
        "## What stands behind it",
        "With SafeDPA's margin the whole corridor can be kept in winds up to "
        f"{largest['balancing']:.2f} m/s (within 45 degrees), {largest['hazard']:.2f} m/s (the long way round); the "
        f"experiments' wind is {wind:g} m/s.",
        latent_table(result),
    ]
    return "\n\n".join(parts) + "\n"


def balancing_table(result: Mapping[str, Any], table: str) -> str:
    """The first question."""
    rows = []
    for row in result["tables"][table]["balancing"].values():
        rows.append(
            f"{row['title']} | {_margin(row)} | {row['safe']}/{row['episodes']} | {percent(row['interval_safe'])} "
            f"| {100 * min(row['safety_rate']):.0f} % | {degrees(min(row['least_room'])):.1f} | {_covered(row)} "
            f"| {100 * row['relaxed']:.1f} %"
        )
    return markdown_table(
        "random torques, within 45 degrees | margin [mrad] | safe | 95 % interval | worst direction "
        "| least room [deg] | steps covered | no torque kept it",
        rows,
    )


def hazard_table(result: Mapping[str, Any], table: str) -> str:
    """The second question."""
    rows = []
    for row in result["tables"][table]["hazard"].values():
        count = row["episodes"]
        rows.append(
            f"{row['title']} | {_margin(row)} | {row['success']}/{count} | {row['safe']}/{count} "
            f"| {row['both']}/{count} | {percent(row['interval_both'])} | {degrees(min(row['least_room'])):.1f} "
            f"| {_covered(row)}"
        )
    return markdown_table(
        "upright past the hazard | margin [mrad] | upright | never in the hazard | both | 95 % interval of both "
        "| least room [deg] | steps covered",
        rows,
    )


def advantages_table(result: Mapping[str, Any], table: str) -> str:
    """SafeDPA against each other: episodes that went well with it alone, with the other alone, and both p."""
    cells = []
    rows: dict[tuple[str, str], dict[str, Any]] = {}
    for row in result["advantages"][table]:
        rows.setdefault((row["question"], row["against"]), {})[row["outcome"]] = row
    for (question, name), outcomes in rows.items():
        title = result["tables"][table][question][name]["title"]
        asked = "within 45 degrees" if question == "balancing" else "past the hazard"
        reported = " | ".join(_advantage(outcomes.get(outcome)) for outcome in _OUTCOMES)
        cells.append(f"{title}, {asked} | {reported}")
    return markdown_table("SafeDPA against | safe | upright | both", cells)


def _advantage(row: Mapping[str, Any] | None) -> str:
    if row is None:
        return "-"
    if not row["only_safedpa"] + row["only_other"]:
        return "the same"
    return (
        f"+{row['only_safedpa']} -{row['only_other']}, p {_p(row['mcnemar_holm'])}, "
        f"by directions {_p(row['directions_holm'])}"
    )


def _p(value: float) -> str:
    return f"{value:.1g}" if value >= 1e-9 else "< 1e-9"


def margins_table(result: Mapping[str, Any]) -> str:
    """How each margin was made."""
    cells = []
    rows = result["tables"]["own"]["balancing"]
    for name, margin in result["margins"].items():
        reported = " | ".join(f"{1000 * margin[key]:.1f}" for key in ("epsilon", "of_a_drive", "first"))
        cells.append(f"{rows[name]['title']} | {reported} | {margin['drives']}, {margin['transitions']}")
    return markdown_table(
        "filter of | margin [mrad] | of a whole drive | behind a filter that knows the wind | drives, steps", cells
    )


def penalties_table(result: Mapping[str, Any]) -> str:
    """Which penalty was chosen, where, and by what."""
    choice = result["penalty"]
    rows = []
    for name, row in choice["rows"].items():
        chosen = ", chosen" if name == choice["chosen"] else ""
        rows.append(f"beta {_beta(name)}{chosen} | {row['both']} | {degrees(row['least_room']):.1f}")
    for axis in result["sweeps"].values():
        if "hazard" in axis:
            betas = ", ".join(_beta(name) for name in axis["hazard"][BEST_PENALTY]["chosen"])
            values = ", ".join(f"{value:g}" for value in axis["shown"])
            rows.append(f"by {axis['label']}, at {values} | beta {betas} |")
    return markdown_table(
        f"RMA-P, {choice['episodes']} episodes of development seed {choice['seed']} | upright and safe "
        "| least room [deg]",
        rows,
    )


def _beta(name: str) -> str:
    return name.removeprefix("rma_p_").replace("_", ".")


def sweeps_table(result: Mapping[str, Any]) -> str:
    """For each number that was changed, the share of good episodes at each of its values."""
    parts = []
    for axis in result["sweeps"].values():
        values = " | ".join(f"{value:g}" for value in axis["shown"])
        lines = [f"| {axis['label']} | {values} |", "|---|" + "---|" * len(axis["shown"])]
        for row in axis.get("balancing", {}).values():
            lines.append(
                f"| {row['title']}, within the edges: safe | {' | '.join(str(count) for count in row['safe'])} |"
            )
        for row in axis.get("hazard", {}).values():
            both = [f"{safe} / {good}" for safe, good in zip(row["safe"], row["both"], strict=True)]
            lines.append(f"| {row['title']}, past the hazard: safe / upright and safe | {' | '.join(both)} |")
        parts.append("\n".join(lines))
    return f"Of {result['directions'] * result['sweep_episodes']} episodes each.\n\n" + "\n\n".join(parts)


def latent_table(result: Mapping[str, Any]) -> str:
    """How far the wind's direction is off."""
    rows = []
    titles = {"around": "swings all around", "balancing": "within 45 degrees, behind the filter"}
    for name, title in titles.items():
        row = result["latent"][name]
        rows.append(
            f"{title} | {row['median_degrees']:.1f} ({row['90_degrees']:.0f}) "
            f"| {row['refined_median_degrees']:.1f} ({row['refined_90_degrees']:.0f}) "
            f"| {row['best_median_degrees']:.2f} "
            f"| {row['best_noisy_median_degrees']:.2f} ({row['best_noisy_90_degrees']:.1f})"
        )
    return markdown_table(
        "wind direction, degrees off: median (90 %) | phi | refined by f and g | best fit | best fit with noise", rows
    )


def _margin(row: Mapping[str, Any]) -> str:
    return "-" if row["epsilon"] is None else f"{1000 * row['epsilon']:.1f}"


def _covered(row: Mapping[str, Any]) -> str:
    return "-" if row["covered"] is None else f"{100 * row['covered']:.1f} %"
