"""Curves over time: latent, barrier, actions, residual. Turns messages into shapes."""

from __future__ import annotations

import math

from safedpa.bus import LatentMessage, VerdictMessage
from safedpa_services.dashboard.display_settings import DisplaySettings
from safedpa_services.dashboard.palette import GREY, ORANGE, PURPLE, SKY, VERMILION, series_colour
from safedpa_services.dashboard.shapes import Bands, Curves, TimelineEntry, gap_if_huge

_MOST_CURVES = 16

_BARRIER = (("h now", SKY, 2.5), ("h predicted", ORANGE, 1.5), ("margin", PURPLE, 1.5), ("threshold", VERMILION, 1.5))
_ACTION = (("nominal", ORANGE, 2.5), ("filtered", SKY, 1.5), ("lowest", GREY, 1.0), ("highest", GREY, 1.0))
"""Name, colour, width of the curves of one pane, in the order of their values."""

_WITHOUT_BARRIER = ("fallback", "disabled", "stopped")


def style_entries(display: DisplaySettings) -> list[TimelineEntry]:
    """Returns the static entries with names, colours and widths of the curves."""
    entries = [TimelineEntry(("barrier",), _styles(_BARRIER), static=True)]
    for variable in display.system.action:
        entries.append(TimelineEntry(("action", variable.name), _styles(_ACTION), static=True))
    shown = zip(display.latent_names, _short(display.latent_names), display.latent_units, strict=True)
    for index, (name, short, unit) in enumerate(shown):
        entries.append(TimelineEntry(("latent", name), Bands(0.0, 0.0, short, unit, series_colour(index)), static=True))
    names = tuple(f"{variable.name} [{variable.unit}]" for variable in display.system.state)
    residual = Curves((), names, tuple(map(series_colour, range(len(names)))), (1.5,) * len(names))
    return [*entries, TimelineEntry(("residual",), residual, static=True)]


def legend_names(display: DisplaySettings) -> tuple[str, ...]:
    """Returns the names of the latents in the legend, with units."""
    named = zip(_short(display.latent_names), display.latent_units, strict=True)
    return tuple(f"{name} [{unit}]" if unit not in ("", "1") else name for name, unit in named)


def _short(names: tuple[str, ...]) -> tuple[str, ...]:
    """Returns the names without the effect's name, if they stay distinct."""
    short = tuple(name.rpartition(".")[2] for name in names)
    return short if len(set(short)) == len(short) else names


def _styles(rows: tuple[tuple[str, int, float], ...]) -> Curves:
    return Curves((), tuple(row[0] for row in rows), tuple(row[1] for row in rows), tuple(row[2] for row in rows))


def latent_entries(latent: LatentMessage, display: DisplaySettings) -> list[TimelineEntry]:
    """Returns an entry for each latent, with its standard deviation."""
    entries = []
    for index, value in enumerate(latent.values[:_MOST_CURVES]):
        known = index < len(display.latent_names)
        name = display.latent_names[index] if known else f"latent {index}"
        deviation = latent.deviations[index] if index < len(latent.deviations) else 0.0
        if not math.isnan(gap_if_huge(value)):
            spread = deviation if gap_if_huge(deviation) >= 0.0 else 0.0
            unit = display.latent_units[index] if known else ""
            entries.append(TimelineEntry(("latent", name), Bands(value, spread, name, unit, series_colour(index))))
    return entries


def barrier_entries(verdict: VerdictMessage) -> list[TimelineEntry]:
    """Returns h now and predicted, the margin and the threshold 0; a gap where the filter did not compute h."""
    unknown = verdict.status in _WITHOUT_BARRIER and verdict.h_now == verdict.h_next == 0.0
    now, ahead = (math.nan, math.nan) if unknown else (verdict.h_now, verdict.h_next)
    return [TimelineEntry(("barrier",), Curves((*map(gap_if_huge, (now, ahead, verdict.margin)), 0.0)))]


def action_entries(verdict: VerdictMessage, display: DisplaySettings) -> list[TimelineEntry]:
    """Returns nominal and filtered action with the actuator limits, for each component of the action."""
    entries = []
    for index, variable in enumerate(display.system.action):
        rows = (verdict.nominal, verdict.action)
        given = (gap_if_huge(row[index]) if index < len(row) else math.nan for row in rows)
        limits = display.action_low[index], display.action_high[index]
        entries.append(TimelineEntry(("action", variable.name), Curves((*given, *limits))))
    return entries


def residual_entry(residual: tuple[float, ...]) -> TimelineEntry:
    """Returns the entry of the residual, the measured minus the predicted state."""
    return TimelineEntry(("residual",), Curves(tuple(gap_if_huge(value) for value in residual)))
