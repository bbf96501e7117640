"""A diagnosis as one offline HTML page: what was missing, why that and nothing else, and how the error fell."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from safedpa.diagnosis.comparison import EVERY, Comparison, compare_model
from safedpa.diagnosis.figures import residual_figure
from safedpa.diagnosis.overlays import chosen_windows, window_figure
from safedpa.diagnosis.page import embedded, rendered
from safedpa.diagnosis.report_excerpt import excerpt
from safedpa.diagnosis.report_figures import before_after_figure, falling_figure, map_figure
from safedpa.diagnosis.report_open import closest_rows, detectable_rows
from safedpa.diagnosis.report_story import number, story_of
from safedpa.diagnosis.rollout import rollout
from safedpa.diagnosis.unexplained_figure import unexplained_figure
from safedpa.dynamics import PhysicsModel
from safedpa.records.atomic import atomic_path
from safedpa.records.run import Run

__all__ = ["report_page", "write_report"]

_MOST_ROWS = 200_000
"""Of longer logs the figures show an excerpt; the numbers in the tables of stages and candidates are those of all."""

_MOST_WINDOWS = 6000
"""More would make a page no clearer."""

_SHOWN = 6
"""Candidates of a stage that stand in the table before the others are unfolded."""


def write_report(
    document: Mapping[str, Any], runs: Sequence[Run], models: Sequence[PhysicsModel], folder: Path, title: str
) -> Path:
    """Writes ``report.html`` into a folder that exists; returns its path.

    ``document`` is what stands in report.json; ``models`` are those of its stages, the first one before anything was
    added. Raises RecordingError when it cannot be written; it is there whole or not at all.
    """
    path = folder / "report.html"
    with atomic_path(path) as temporary:
        temporary.write_text(report_page(document, runs, models, title), encoding="utf-8")
    return path


def report_page(
    document: Mapping[str, Any], runs: Sequence[Run], models: Sequence[PhysicsModel], title: str, horizon: float = 1.0
) -> str:
    """The page's text: figures, tables and plotly.js in one file that asks no other host for anything."""
    horizon = float(document.get("horizon", horizon))
    seconds = sum(run.duration for run in runs)
    shown = excerpt(runs, _MOST_ROWS, horizon)
    every = max(EVERY, sum(run.duration for run in shown) / _MOST_WINDOWS)
    before = compare_model(models[0], shown, horizon, every=every)
    after = before if len(models) == 1 else compare_model(models[-1], shown, horizon, every=every)
    figures = [falling_figure(document), before_after_figure(before, after), residual_figure(after)]
    maps = map_figure(before, after)
    figures += [] if maps is None else [maps]
    rest = unexplained_figure(document["unexplained"])
    figures += [] if rest is None else [rest]
    overlays = _overlays(before, after)
    return rendered(
        "report_page.html",
        title=title,
        document=document,
        story=story_of(document),
        before=before,
        after=after,
        closest=closest_rows(document),
        detectable=detectable_rows(document),
        worse=document.get("worse", ()),
        tiles=_tiles(document, before, seconds, len(runs)),
        has_maps=maps is not None,
        has_rest=rest is not None,
        share=sum(run.duration for run in shown) / seconds,
        shown=_SHOWN,
        overlay_labels=[figure["label"] for figure in overlays],
        data=embedded({"figures": figures, "overlays": overlays}),
    )


def _tiles(document: Mapping[str, Any], before: Comparison, seconds: float, runs: int) -> list[tuple[str, str]]:
    stages = document["stages"]
    first, last = number(stages[0]["heldout_error"]), number(stages[-1]["heldout_error"])
    tiles = [(f"{first:.3g}", "held-out error of the given model")]
    if len(stages) > 1:
        tiles.append((f"{last:.3g}", "with what was found"))
        tiles.append((f"{100 * (last / first - 1):+.0f} %".replace("-", "−"), "change of the error"))
        tiles.append((str(stages[-1]["runs_improved"]), "runs improved"))
    tiles.append((f"{before.horizon:g} s", "horizon of the predictions"))
    tiles.append((f"{seconds:.0f} s", f"measured in {runs} run{'s' if runs > 1 else ''}"))
    return tiles


def _overlays(before: Comparison, after: Comparison) -> list[dict[str, Any]]:
    """Measured and predicted, before and after, in windows from the worst of the given model to its best."""
    chosen = chosen_windows(before)
    windows = before.windows.select(np.array([index for _, index in chosen], dtype=np.int64))
    lines = {"before": rollout(before.model, windows)}
    if after is not before:
        lines["after"] = rollout(after.model, windows)
    figures = []
    for place, (kind, index) in enumerate(chosen):
        rows = windows.steps[place] + 1
        figure = window_figure(windows, place, {name: states[:rows, place] for name, states in lines.items()})
        at, run = windows.time[windows.start[place]], windows.names[windows.run[place]]
        errors = f"error {before.window_errors[index]:.2f}"
        errors += "" if after is before else f" before, {after.window_errors[index]:.2f} after"
        figure["label"] = f"{kind}: {errors}, {run} at {at:.1f} s"
        figures.append(figure)
    return figures
