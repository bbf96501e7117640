"""The pendulum's story as Markdown, JSON and one picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from safedpa_lab.provenance.record import write_result

__all__ = ["story_markdown", "write_story"]

_COLOURS = {"shipped": "#7A8590", "shipped, margin of the diagnosed": "#DCE1E6", "oracle": "#222222"}
_DIAGNOSED, _LEARNED = "#0072B2", "#E69F00"


def write_story(result: dict[str, Any], out: Path) -> None:
    """``pendulum-story.json``, ``pendulum-story.md`` and ``pendulum_story.png`` in the folder."""
    out.mkdir(parents=True, exist_ok=True)
    write_result(out / "pendulum-story.json", result)
    (out / "pendulum-story.md").write_text(story_markdown(result), encoding="utf-8")
    _picture(result, out / "pendulum_story.png")


def story_markdown(result: dict[str, Any]) -> str:
    """For each hidden thing a sentence and a table; then the user's payloads, where they were run."""
    parts = [
        f"{result['directions']} wind directions x {result['episodes']} episodes of {result['seconds']:g} s, "
        f"{result['wind']:g} m/s, seed {result['seed']}, {result['date']}.\n"
    ]
    parts += [_case(name, case) for name, case in result["cases"].items()]
    if "payloads" in result:
        parts.append(_payloads(result["payloads"]))
    return "\n".join(parts)


def _case(name: str, case: dict[str, Any]) -> str:
    true = ", ".join(f"{effect} {value:g}" for effect, entries in case["true"].items() for value in entries.values())
    found = ", ".join(_value(case["values"], effect) for effect in case["added"]) or "nothing"
    error = " to ".join(f"{value:.3g}" for value in (case["error"][0], case["error"][-1]))
    lines = [
        f"**{name}** (in truth {true}): added {found}; held-out error {error}.\n",
        "| model | margin [mrad] | safe | 95 % interval | least room [deg] | uses of 45 degrees | corrected |",
        "|---|---|---|---|---|---|---|",
    ]
    for title, row in case["rows"].items():
        low, high = row["interval_safe"]
        lines.append(
            f"| {title} | {1000 * row['margin']:.1f} | {row['safe']}/{row['episodes']} "
            f"| {100 * low:.0f} to {100 * high:.0f} % | {np.degrees(row['least_room']):.1f} "
            f"| {np.degrees(row['reach']):.1f} | {100 * row['corrected']:.0f} % |"
        )
    return "\n".join(lines) + "\n"


def _value(values: dict[str, Any], effect: str) -> str:
    own = [item for path, item in values.items() if path.startswith(f"{effect}.")]
    return f"{effect} " + ", ".join(f"{item['value']:.3f} +- {item['std'] or 0.0:.3f} {item['unit']}" for item in own)


def _payloads(found: dict[str, Any]) -> str:
    lines = [
        f"A user's pendulum, identified from the real logs (mass {found['identified']['base.mass']:.3f} kg): "
        f"`tip_mass` named first in {found['first']} of {found['cases']} cases, within two deviations in "
        f"{found['within_two_deviations']}; without a payload something was added in {found['false_alarms']}.\n",
        "| payload [kg] | seed | added | mass [kg] | held-out error |",
        "|---|---|---|---|---|",
    ]
    for row in found["rows"]:
        mass = "" if row["value"] is None else f"{row['value']:.4f} +- {row['std'] or 0.0:.4f}"
        error = " to ".join(f"{value:.4f}" for value in dict.fromkeys((row["error"][0], row["error"][-1])))
        lines.append(f"| {row['mass']:g} | {row['seed']} | {', '.join(row['added'])} | {mass} | {error} |")
    return "\n".join(lines) + "\n"


def _picture(result: dict[str, Any], path: Path) -> None:
    """Left the margins, right how much of the 45 degrees is used; one group of bars for each hidden thing."""
    from safedpa_lab.experiments.car_style import bare, figure, heading

    cases = result["cases"]
    names = list(next(iter(cases.values()))["rows"])
    width = 0.8 / len(names)
    with figure(path, 3.4) as drawn:
        panels = drawn.subplots(1, 2)
        for number, name in enumerate(names):
            at = np.arange(len(cases)) + (number - 0.5 * (len(names) - 1)) * width
            colour = _COLOURS.get(name, _LEARNED if name.startswith("learned") else _DIAGNOSED)
            rows = [case["rows"][name] for case in cases.values()]
            hatch = "//" if name == "learned" else None
            look: dict[str, Any] = {"color": colour, "hatch": hatch, "edgecolor": "white", "linewidth": 0.5}
            panels[0].bar(at, [1000 * row["margin"] for row in rows], width, label=name, **look)
            panels[1].bar(at, [np.degrees(row["reach"]) for row in rows], width, **look)
            for place, row in zip(at, rows, strict=True):
                if row["safe"] < row["episodes"]:
                    missed = f"{row['episodes'] - row['safe']} left"
                    panels[1].text(place, np.degrees(row["reach"]), missed, fontsize=6, rotation=90, ha="center")
        for axes, title in zip(panels, ("margin [mrad]", "95 % quantile of the tilt [deg]"), strict=True):
            axes.set_xticks(range(len(cases)), list(cases))
            axes.set_title(title, fontsize=9)
            bare(axes)
        panels[1].set_ylim(25, 47)
        panels[1].axhline(45.0, color="#D55E00", linewidth=1.0)
        drawn.legend(loc="outside lower center", ncols=len(names), fontsize=6.5, frameon=False)
        heading(drawn, "What knowing the missing effect is worth: a smaller margin, more of the 45 degrees")
