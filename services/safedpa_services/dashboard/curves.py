"""What goes over time: latent, barrier, actions, residual. Messages in, shapes out."""

from __future__ import annotations

import math

from safedpa.bus import LatentMessage, VerdictMessage
from safedpa_services.dashboard.look import Look
from safedpa_services.dashboard.palette import GREY, ORANGE, PURPLE, SERIES, SKY, VERMILLION
from safedpa_services.dashboard.shapes import Bands, Curves, Entry

__all__ = ["action_entries", "barrier_entries", "latent_entries", "residual_entry", "style_entries"]

_MOST_CURVES = 16
_LARGEST = 1e12
"""Of any unit; beyond it a curve has a gap, since one such number flattens the plot."""

_WITHOUT_BARRIER = ("fallback", "disabled")


def style_entries(look: Look) -> list[Entry]:
    """Names, colours and widths of the curves; static."""
    entries = [
        _style(("barrier", "now"), "h now", SKY, 2.5),
        _style(("barrier", "predicted"), "h predicted", ORANGE, 1.5),
        _style(("barrier", "margin"), "margin epsilon", PURPLE, 1.5),
        _style(("barrier", "threshold"), "threshold", VERMILLION, 1.5),
    ]
    for variable in look.system.action:
        limits = Curves((), ("lowest", "highest"), (GREY, GREY), (1.0, 1.0))
        entries += [
            Entry(("action", variable.name, "limits"), limits, static=True),
            _style(("action", variable.name, "wish"), "wish", ORANGE, 2.5),
            _style(("action", variable.name, "filtered"), "filtered", SKY, 1.5),
        ]
    names = tuple(f"{variable.name} [{variable.unit}]" for variable in look.system.state)
    colours = tuple(SERIES[index % len(SERIES)] for index in range(len(names)))
    residual = Curves((), names, colours, tuple(1.5 for _ in names))
    return [*entries, Entry(("residual",), residual, static=True)]


def _style(path: tuple[str, ...], name: str, colour: int, width: float) -> Entry:
    return Entry(path, Curves((), (name,), (colour,), (width,)), static=True)


def latent_entries(latent: LatentMessage, look: Look) -> list[Entry]:
    """Each entry of the latent with its standard deviation, named by the model."""
    entries = []
    for index, value in enumerate(latent.values[:_MOST_CURVES]):
        known = index < len(look.latent_names)
        name = look.latent_names[index] if known else f"latent {index}"
        deviation = latent.deviations[index] if index < len(latent.deviations) else 0.0
        if _plottable(value):
            spread = deviation if 0.0 <= deviation < _LARGEST else 0.0
            unit = look.latent_units[index] if known else ""
            entries.append(Entry(("latent", name), Bands(value, spread, name, unit, SERIES[index % len(SERIES)])))
    return entries


def barrier_entries(verdict: VerdictMessage) -> list[Entry]:
    """h now and predicted, its threshold 0 and the margin; nothing of h where the filter did not compute it."""
    entries = [
        Entry(("barrier", "threshold"), Curves((0.0,))),
        Entry(("barrier", "margin"), Curves((_gap(verdict.margin),))),
    ]
    unknown = verdict.status in _WITHOUT_BARRIER and verdict.h_now == verdict.h_next == 0.0
    now, ahead = (math.nan, math.nan) if unknown else (verdict.h_now, verdict.h_next)
    return [
        *entries,
        Entry(("barrier", "now"), Curves((_gap(now),))),
        Entry(("barrier", "predicted"), Curves((_gap(ahead),))),
    ]


def action_entries(verdict: VerdictMessage, look: Look) -> list[Entry]:
    """Wish and filtered action of each entry of the action, between the actuator's limits."""
    entries = []
    for index, variable in enumerate(look.system.action):
        for name, values in (("wish", verdict.wish), ("filtered", verdict.action)):
            value = values[index] if index < len(values) else math.nan
            entries.append(Entry(("action", variable.name, name), Curves((_gap(value),))))
        limits = Curves((look.action_low[index], look.action_high[index]))
        entries.append(Entry(("action", variable.name, "limits"), limits))
    return entries


def residual_entry(residual: tuple[float, ...]) -> Entry:
    """Measured minus predicted state."""
    return Entry(("residual",), Curves(tuple(_gap(value) for value in residual)))


def _plottable(value: float) -> bool:
    return math.isfinite(value) and abs(value) < _LARGEST


def _gap(value: float) -> float:
    return value if _plottable(value) else math.nan
