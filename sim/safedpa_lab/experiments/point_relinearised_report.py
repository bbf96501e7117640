"""Models that are not affine in the action, as Markdown and JSON."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from safedpa_lab.provenance.record import write_result

__all__ = ["against_table", "car_table", "models_table", "relinearised_markdown", "rows_table", "write_relinearised"]

_TITLES: Final = {
    "affine": "affine networks",
    "nominal": "free networks about the nominal action",
    "own": "free networks about the filter's own action",
    "truth": "the body itself about the filter's own action",
}


def write_relinearised(result: Mapping[str, Any], out: Path) -> None:
    """``relinearised.json`` and ``relinearised.md`` in the folder."""
    out.mkdir(parents=True, exist_ok=True)
    write_result(out / "relinearised.json", result)
    (out / "relinearised.md").write_text(relinearised_markdown(result), encoding="utf-8")


def relinearised_markdown(result: Mapping[str, Any]) -> str:
    """Networks, rows, tests, and the car where it was asked for."""
    parts = ["## Networks", models_table(result), "## Filters told z = mu(e)", rows_table(result)]
    parts += ["## Against the affine networks", against_table(result)]
    if "car" in result:
        parts += ["## The car's networks", car_table(result)]
    return "\n\n".join(parts) + "\n"


def models_table(result: Mapping[str, Any]) -> str:
    """One-step errors of the point robot's networks on fresh transitions."""
    lines = [
        "| thrust | networks | velocity, mm/s | yaw, mrad | explained of the velocity, % | no affine one can, % |",
        "|---|---|---|---|---|---|",
    ]
    for row in result["networks"]:
        lines.append(
            f"| {row['thrust']} | {row['form']} | {1e3 * row['velocity']:.2f} | {1e3 * row['yaw']:.2f} "
            f"| {100 * row['explained']:.4f} | {100 * row['not_affine']:.4f} |"
        )
    return "\n".join(lines)


def rows_table(result: Mapping[str, Any]) -> str:
    """Each filter with its own margin, by thrust and nominal action."""
    lines = [
        f"{result['directions']} directions x {result['episodes']} episodes of {result['steps']} steps, evaluation "
        f"seed {result['evaluation_seed']}; margins of {100 * result['coverage']:g} % over {result['drives']} drives "
        f"of {result['drive_steps']} steps, calibration seed {result['calibration_seed']}; {result['date']}.\n",
        "| thrust | nominal action | filter, told z = mu(e) | error, median / 99 %, mm | margin, mm | episodes without cost, % "
        "| goals | corrected, % | us a decision |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in result["rows"]:
        low, high = row["safe_interval"]
        reported = " / ".join(_millimetres(row[name]) for name in ("median_error", "error_99"))
        lines.append(
            f"| {row['thrust']} | {row['nominal']} | {_TITLES[row['filter']]} | {reported} | {_millimetres(row['epsilon'])} "
            f"| {100 * row['safe'] / row['count']:.1f} ({100 * low:.1f} to {100 * high:.1f}) | {row['goals'][0]:.1f} "
            f"| {100 * row['corrected']:.1f} | {row['microseconds']:.0f} |"
        )
    return "\n".join(lines)


def against_table(result: Mapping[str, Any]) -> str:
    """Episodes that only one of the two drove without cost."""
    lines = [
        "| thrust | nominal action | against the affine networks | safe | p | goals more |",
        "|---|---|---|---|---|---|",
    ]
    for row in result["against"]:
        mean, low, high = row["goals_less"]
        lines.append(
            f"| {row['thrust']} | {row['nominal']} | {_TITLES[row['filter']]} | +{row['only_it']} -{row['only_affine']} "
            f"| {row['holm']:.1g} | {mean:.1f} ({low:.1f} to {high:.1f}) |"
        )
    return "\n".join(lines)


def car_table(result: Mapping[str, Any]) -> str:
    """One-step errors of the car's networks, state by state."""
    car = result["car"]
    lines = [
        f"{car['pairs']:,} pairs each, two layers of {car['hidden']} in f and g, seed {car['seed']}.\n",
        "| state | affine, error | free, error | affine, not explained | free, not explained | no affine one can |",
        "|---|---|---|---|---|---|",
    ]
    for index, name in enumerate(car["states"]):
        affine, free = car["affine"], car["free"]
        left = (f"{100 * (1.0 - one['explained'][index]):.3f} %" for one in (affine, free))
        errors = (f"{one['rms_error'][index]:.2e}" for one in (affine, free))
        lines.append(f"| {name} | {' | '.join([*errors, *left])} | {100 * car['not_affine'][index]:.3f} % |")
    return "\n".join(lines)


def _millimetres(length: float | None) -> str:
    return "none" if length is None else f"{1e3 * length:.2f}"
