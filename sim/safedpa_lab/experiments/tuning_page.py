"""The page of a result of ``safedpa experiment tuning``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

from safedpa_lab.experiments.car_errors import OWN_STATES
from safedpa_lab.experiments.tuning_errors import HORIZONS, METRICS

__all__ = ["tuning_page"]

_METRICS: Final = {
    "root_mean_square": "Root mean square",
    "mean_square": "Mean square",
    "squared_norm": "Squared norm, raw SI units",
}
_HORIZONS: Final = {"one_step": "one step (0.05 s)", "one_second": "one second"}
_GROUPS: Final = {"none": "without a load", "loads": "with loads", "mixed": "all together"}
_BASES: Final = {"untuned": "as trained", "untuned_point": "at the right point"}
_UNITS: Final = ("mm", "mm", "mrad", "mm/s")


def tuning_page(result: Mapping[str, Any]) -> str:
    """Markdown: every metric and ratio, errors by state, what online tuning took, the real car; and the command."""
    made = result.get("provenance", {})
    lines = ["# Tuning, row by row", "", f"`{made.get('command')}`, {str(made.get('date'))[:10]}", ""]
    if "car" in result:
        lines += _car(result["car"])
    if "real" in result:
        lines += _real(result["real"])
    return "\n".join(lines).rstrip() + "\n"


def _car(car: Mapping[str, Any]) -> list[str]:
    seeds, drives = car["seeds"], car["drives"]
    development = " and ".join(f"{first} to {last}" for first, last in seeds["development"])
    lines = [
        f"Fresh drives: {drives['each']} of {drives['ticks']} periods with each load, seeds {_span(seeds['fresh'])}; a "
        f"robot's own drives, on which it tunes itself online: {drives['own_ticks']} periods each, seeds "
        f"{_span(seeds['own'])}. Settings were chosen on seeds {development}. Ratios: how many times less than the "
        "untuned networks; 95 % intervals over drives, in pairs.",
        "",
    ]
    for metric in METRICS:
        for horizon in HORIZONS:
            lines += [
                f"## {_METRICS[metric]}, {_HORIZONS[horizon]}",
                "",
                *_table(car, metric, horizon),
                "",
            ]
    refused = [f"{row['title']}: {row['refused']}" for row in car["rows"].values() if row["refused"]]
    return [*lines, *_states(car), *_loads(car), *_taken(car), *refused]


def _table(car: Mapping[str, Any], metric: str, horizon: str) -> list[str]:
    head = [
        f"{reported}: {word}"
        for reported in _GROUPS.values()
        for word in ("error", *(f"times, {b}" for b in _BASES.values()))
    ]
    lines = ["| | " + " | ".join(head) + " |", "|---" * (1 + len(head)) + "|"]
    for row in car["rows"].values():
        cells = []
        for group in _GROUPS:
            cells.append(f"{row['metrics'][group][horizon][metric]:.3g}")
            ratios = row["ratios"][group][horizon]
            cells += [_ratio(ratios[base][metric]) if base in ratios else "1" for base in _BASES]
        lines.append(f"| {row['title']} | " + " | ".join(cells) + " |")
    return lines


def _states(car: Mapping[str, Any]) -> list[str]:
    lines = []
    for horizon in HORIZONS:
        head = [
            f"{reported}: {state}, {unit}"
            for reported in ("without a load", "with loads")
            for state, unit in zip(OWN_STATES, _UNITS, strict=True)
        ]
        lines += [f"## By state, {_HORIZONS[horizon]}", "", "Root mean square.", ""]
        lines += ["| | " + " | ".join(head) + " |", "|---" * (1 + len(head)) + "|"]
        for row in car["rows"].values():
            found = [row["metrics"][group][horizon][state] for group in ("none", "loads") for state in OWN_STATES]
            lines.append(f"| {row['title']} | " + " | ".join(_short(1000.0 * value) for value in found) + " |")
        lines.append("")
    return lines


def _loads(car: Mapping[str, Any]) -> list[str]:
    loads = [name for name in next(iter(car["rows"].values()))["metrics"] if name not in ("loads", "mixed")]
    lines = []
    for horizon in HORIZONS:
        lines += [
            f"## By load, root mean square, {_HORIZONS[horizon]}",
            "",
            "In brackets: times less than as trained.",
            "",
        ]
        lines += ["| | " + " | ".join(loads) + " |", "|---" * (1 + len(loads)) + "|"]
        for row in car["rows"].values():
            cells = []
            for load in loads:
                ratios = row["ratios"][load][horizon]
                times = f" ({_ratio(ratios['untuned']['root_mean_square'])})" if "untuned" in ratios else ""
                cells.append(f"{row['metrics'][load][horizon]['root_mean_square']:.3g}{times}")
            lines.append(f"| {row['title']} | " + " | ".join(cells) + " |")
        lines.append("")
    return lines


def _taken(car: Mapping[str, Any]) -> list[str]:
    rows = [row for row in car["rows"].values() if "taken" in row]
    if not rows:
        return []
    lines = [
        "## What online tuning took",
        "",
        "Root mean square, scaled, on each of the robot's own drives by what was fitted to the other.",
        "",
        "| | load | ridge | one step: before | after | one second: before | after |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        for load, taken in row["taken"].items():
            after = taken["after"] or ("refused: not better", "refused")
            cells = [cell for pair in zip(taken["before"], after, strict=True) for cell in pair]
            reported = " | ".join(cell if isinstance(cell, str) else f"{cell:.3g}" for cell in cells)
            lines.append(f"| {row['title']} | {load} | {taken['ridge'] or ''} | {reported} |")
    return [*lines, ""]


def _real(real: Mapping[str, Any]) -> list[str]:
    if "left_out" in real:
        return ["## The real car", "", f"Left out: {real['left_out']}.", ""]
    lines = [
        "## The real car",
        "",
        f"Judged on the second half of the log named. Margin: conformal, {100.0 * real['coverage']:g} %, of the error "
        "of the position, from the last quarters of the logs that were tuned on. Error: root mean square, scaled.",
        "",
        "| log | | one step: error | margin, mm | covered, % | one second: error | margin, mm | covered, % |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for fold in real["folds"]:
        day = " (another day)" if fold.get("other_day") else ""
        for name, row in fold["rows"].items():
            cells = []
            for horizon in HORIZONS:
                one = row[horizon]
                cells += [
                    _short(one["root_mean_square"]),
                    _short(1000.0 * one["margin"]),
                    f"{100.0 * one['covered']:.1f}",
                ]
            notice = f" ({fold['notice'][name]})" if name in fold["notice"] else ""
            lines.append(f"| {fold['log']}{day} | {real['titles'][name]}{notice} | " + " | ".join(cells) + " |")
    return [*lines, ""]


def _short(value: float) -> str:
    """Three digits, and no power of ten where it is large."""
    return f"{value:.0f}" if abs(value) >= 100.0 else f"{value:.3g}"


def _ratio(ratio: Sequence[float]) -> str:
    return f"{_short(ratio[0])} ({_short(ratio[1])} to {_short(ratio[2])})"


def _span(seeds: Sequence[int]) -> str:
    return f"{seeds[0]} to {seeds[1]}"
