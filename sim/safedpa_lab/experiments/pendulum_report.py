"""The pendulum experiment as Markdown, JSON and pictures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from safedpa.safety import MarginCalibration

__all__ = ["markdown_of", "write_report"]


def write_report(result: dict[str, Any], out: Path) -> None:
    """``pendulum.json``, ``pendulum.md``, the learned model's ``margin.toml`` and one PNG a figure in the folder."""
    from safedpa_lab.experiments.pendulum_figures import write_figures

    out.mkdir(parents=True, exist_ok=True)
    (out / "pendulum.json").write_text(json.dumps(_without_points(result), indent=1) + "\n", encoding="utf-8")
    (out / "pendulum.md").write_text(markdown_of(result), encoding="utf-8")
    _margin_of(result).save(out / "margin.toml")
    write_figures(result, out)


def _without_points(result: dict[str, Any]) -> dict[str, Any]:
    """What was found, without the points that only the figures need."""
    hazard = {name: {key: row[key] for key in row if key != "shown"} for name, row in result["hazard"].items()}
    latent = {
        name: {key: value for key, value in row.items() if key not in ("latents", "refined", "directions")}
        for name, row in result["latent"].items()
    }
    return {**result, "hazard": hazard, "latent": latent}


def _margin_of(result: dict[str, Any]) -> MarginCalibration:
    margin = result["margin"]
    return MarginCalibration(
        epsilon={"corridor": margin["epsilon"]},
        coverage=margin["coverage"],
        transitions=margin["transitions"],
        date=result["date"],
        fingerprint=margin["fingerprint"],
        covered={"conformal.corridor": margin["fresh_coverage"]},
    )


def markdown_of(result: dict[str, Any]) -> str:
    """Both questions as tables, then margin, invariance and latent."""
    head = f"{result['directions']} wind directions x {result['episodes']} episodes, seed {result['seed']}"
    parts = [f"{head}, {result['date']}.\n" if result["date"] else f"{head}.\n", _balancing(result), _hazard(result)]
    margin, largest, latent = result["margin"], result["invariance"]["largest_wind"], result["latent"]
    wind = result["assumed"]["wind"]
    parts.append(
        f"Margin of every filter: {1000 * margin['epsilon']:.2f} mrad, 99 % of {margin['transitions']} one-step "
        f"errors; it covers {100 * margin['fresh_coverage']:.1f} % of {margin['fresh_transitions']} others.\n\n"
        f"Winds in which the whole corridor can be kept: up to {largest['balancing']:.2f} m/s (within 45 degrees), "
        f"{largest['hazard']:.2f} m/s (the long way round); the experiments' wind is {wind:g} m/s.\n\n"
        + _latent(latent)
    )
    return "\n".join(parts)


def _balancing(result: dict[str, Any]) -> str:
    lines = [
        "| random torques, within 45 degrees | safe | 95 % interval | worst direction | least room [deg] | corrected |",
        "|---|---|---|---|---|---|",
    ]
    for row in result["balancing"].values():
        worst = min(row["safety_rate"])
        room = min(row["least_room"]) * 57.29578
        lines.append(
            f"| {row['title']} | {row['safe']}/{row['episodes']} | {_interval(row['interval_safe'])} "
            f"| {100 * worst:.0f} % | {room:.1f} | {100 * row['corrected']:.0f} % |"
        )
    return "\n".join(lines) + "\n"


def _hazard(result: dict[str, Any]) -> str:
    lines = [
        "| upright past the hazard | upright | never in the hazard | both | 95 % interval of both | least room [deg] |",
        "|---|---|---|---|---|---|",
    ]
    for row in result["hazard"].values():
        count = row["episodes"]
        lines.append(
            f"| {row['title']} | {row['success']}/{count} | {row['safe']}/{count} | {row['both']}/{count} "
            f"| {_interval(row['interval_both'])} | {min(row['least_room']) * 57.29578:.1f} |"
        )
    return "\n".join(lines) + "\n"


def _interval(ends: list[float]) -> str:
    return f"{100 * ends[0]:.1f} to {100 * ends[1]:.1f} %"


def _latent(latent: dict[str, Any]) -> str:
    lines = [
        "| wind direction, degrees off: median (90 %) | phi | refined by f and g | best fit | best fit with noise |",
        "|---|---|---|---|---|",
    ]
    titles = {"around": "swings all around", "balancing": "within 45 degrees, behind the filter"}
    for name, title in titles.items():
        row = latent[name]
        lines.append(
            f"| {title} | {row['median_degrees']:.1f} ({row['90_degrees']:.0f}) "
            f"| {row['refined_median_degrees']:.1f} ({row['refined_90_degrees']:.0f}) "
            f"| {row['best_median_degrees']:.2f} "
            f"| {row['best_noisy_median_degrees']:.2f} ({row['best_noisy_90_degrees']:.1f}) |"
        )
    return "\n".join(lines) + "\n"
