"""Writes a comparison as one offline HTML page."""

from __future__ import annotations

import json
from importlib.resources import files
from pathlib import Path
from typing import Any

from safedpa.comparison.comparison import PREDICTORS, Comparison
from safedpa.comparison.summary import as_json, bin_text, worst_bins
from safedpa.records.writers.tables import atomic_path
from safedpa.report.comparison_figures import (
    MOST_RUNS,
    horizon_figure,
    position_figure,
    residual_figure,
    time_figure,
    where_figure,
)
from safedpa.report.overlays import overlay_figures


def write_comparison(comparison: Comparison, folder: Path, title: str) -> tuple[Path, Path]:
    """Writes ``compare.html`` and ``compare.json`` into an existing folder and returns both paths.

    Each file is written completely or not at all. Raises RecordingError if one cannot be written.
    """
    page, data = folder / "compare.html", folder / "compare.json"
    with atomic_path(page) as temporary:
        temporary.write_text(compare_page(comparison, title), encoding="utf-8")
    with atomic_path(data) as temporary:
        temporary.write_text(json.dumps(as_json(comparison), indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return page, data


def compare_page(comparison: Comparison, title: str) -> str:
    """Returns the page: figures, tables and plotly.js in one file that loads nothing from other hosts."""
    position = position_figure(comparison)
    figures = [horizon_figure(comparison), where_figure(comparison), time_figure(comparison)]
    figures += [residual_figure(comparison)] if position is None else [position, residual_figure(comparison)]
    overlays = overlay_figures(comparison)
    return rendered(
        "comparison_page.html",
        title=title,
        comparison=comparison,
        sentences=as_json(comparison)["summary"],
        tiles=_tiles(comparison),
        states=comparison.windows.system.state,
        horizons=_table_horizons(comparison),
        predictors=PREDICTORS,
        worst=[(bin_text(item), item) for item in worst_bins(comparison)[:12]],
        most_runs=MOST_RUNS,
        has_position=position is not None,
        overlay_labels=[figure["label"] for figure in overlays],
        data=embedded({"figures": figures, "overlays": overlays}),
    )


def rendered(template: str, **values: Any) -> str:
    """Renders a template of this package with plotly.js, the drawing script and the common style included."""
    from jinja2 import Environment, StrictUndefined

    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    package = files("safedpa.report")
    plotly = files("plotly").joinpath("package_data", "plotly.min.js").read_text(encoding="utf-8")
    style = package.joinpath("page.css").read_text(encoding="utf-8")
    drawing = package.joinpath("figures.js").read_text(encoding="utf-8")
    page = environment.from_string(package.joinpath(template).read_text(encoding="utf-8"))
    return page.render(plotly=plotly, style=style, drawing=drawing, **values)


def _tiles(comparison: Comparison) -> list[tuple[str, str]]:
    last = comparison.horizons[-1].errors
    seconds = sum(run.duration for run in comparison.runs)
    return [
        (f"{last['model'].value:.2f}", "error of the model"),
        (f"{last['no_change'].value:.2f}", "no change"),
        (f"{last['constant_velocity'].value:.2f}", "constant velocity"),
        (f"{comparison.horizon:g} s", "horizon"),
        (f"{len(comparison.windows)}", "windows"),
        (f"{seconds:.0f} s", f"measured in {len(comparison.runs)} run{'s' if len(comparison.runs) > 1 else ''}"),
    ]


def _table_horizons(comparison: Comparison) -> list[Any]:
    """Returns the errors after a fifth, half and the whole of the horizon, as far as they exist."""
    count = len(comparison.horizons)
    picked = sorted({max(1, round(count * share)) for share in (0.2, 0.5, 1.0)})
    return [comparison.horizons[index - 1] for index in picked]


def embedded(data: dict[str, Any]) -> str:
    """Returns JSON that is safe inside a script element."""
    # Escaped, so that text in the data cannot close the script element.
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
