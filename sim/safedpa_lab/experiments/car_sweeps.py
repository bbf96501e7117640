"""What ``car-curves`` makes harder step by step: each sweep, its values, and the episodes at a value."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, final

from safedpa.errors import InputError, did_you_mean
from safedpa_lab.experiments.car_conditions import TOWING, Conditions
from safedpa_lab.experiments.car_scenes import HEAVIER, PASSAGE
from safedpa_sim.robots.loads import LOADS

__all__ = ["LOAD", "SWEEPS", "Place", "Sweep", "chosen_sweeps"]

LOAD: Final = "chair"
"""What is towed where the sweep is not about the load: no policy of the paper's family has met it."""

_MASSES: Final[Mapping[float, str]] = {
    0.0: "none",
    **{load.mass_ratio: name for name, load in (*LOADS.items(), *HEAVIER.items())},
}
"""Mass of the load over the car's, and its name."""


@final
@dataclass(frozen=True)
class Place:
    """Where a point of a curve is measured."""

    load: str
    conditions: Conditions


@final
@dataclass(frozen=True)
class Sweep:
    """One thing that is made harder, from easy to hard."""

    name: str
    label: str
    """What the values are, with their unit as they are shown."""
    values: tuple[float, ...]
    """In SI units, or shares; the towing as its place in ``TOWING``."""
    shown: tuple[str, ...]
    """The values as they stand under a picture and in a table."""
    usual: float | None
    """The value of the experiment itself; None where none of the values is."""

    def __post_init__(self) -> None:
        if len(self.values) != len(self.shown):
            raise ValueError(f"{self.name}: got {len(self.values)} values and {len(self.shown)} names for them")

    def at(self, value: float) -> Place:
        """The load and the conditions at one of the values."""
        if self.name == "load":
            return Place(_MASSES[value], Conditions())
        if value == self.usual:
            return Place(LOAD, Conditions())
        return Place(LOAD, _changed(self.name, value))


def _changed(name: str, value: float) -> Conditions:
    """With one thing changed."""
    if name == "towing":
        return Conditions(towing=TOWING[int(value)])
    if name == "row":
        return Conditions(passage=value, row=True)
    if name == "delay_untold":
        return Conditions(delay=value, reported=False)
    changed: dict[str, Any] = {name: value}
    return Conditions(**changed)


def _reported(values: tuple[float, ...], scale: float = 1.0) -> tuple[str, ...]:
    return tuple(f"{scale * value:g}" for value in values)


_PASSAGES: Final = (PASSAGE, 0.3, 0.2, 0.1, 0.05)
_SPEEDS: Final = (0.75, 1.0, 1.25, 1.5)
_FRICTIONS: Final = (1.0, 0.8, 0.6, 0.4)
_NOISES: Final = (0.0, 0.01, 0.02, 0.04)
_DELAYS: Final = (0.0, 0.05, 0.10, 0.15)
_TOWING: Final = ("never", "to_a_third", "from_a_third", "always")

SWEEPS: Final[Mapping[str, Sweep]] = {
    sweep.name: sweep
    for sweep in (
        Sweep("passage", "room in a passage [m]", _PASSAGES, _reported(_PASSAGES), PASSAGE),
        Sweep("row", "room, no way around [m]", _PASSAGES, _reported(_PASSAGES), None),
        Sweep("load", "load / car, by mass", tuple(_MASSES), _reported(tuple(_MASSES)), LOADS[LOAD].mass_ratio),
        Sweep(
            "towing",
            f"{LOAD} hitched",
            tuple(float(TOWING.index(name)) for name in _TOWING),
            ("never", "up to 1/3", "from 1/3", "always"),
            float(TOWING.index("always")),
        ),
        Sweep("speed", "speed, x 2 m/s at most", _SPEEDS, _reported(_SPEEDS), 1.0),
        Sweep("friction", "grip of the tyres, x 0.9", _FRICTIONS, _reported(_FRICTIONS), 1.0),
        Sweep("noise", "noise of x and y [cm]", _NOISES, _reported(_NOISES, 100.0), 0.0),
        Sweep("delay", "delay, filter told [ms]", _DELAYS, _reported(_DELAYS, 1000.0), 0.0),
        Sweep("delay_untold", "delay, no one told [ms]", _DELAYS, _reported(_DELAYS, 1000.0), 0.0),
    )
}
"""Each from easy to hard."""


def chosen_sweeps(names: tuple[str, ...]) -> list[Sweep]:
    """Those of these names, all without any. Raises InputError for a name that there is not."""
    for name in names:
        if name not in SWEEPS:
            raise InputError(f"sweep '{name}': {did_you_mean(name, SWEEPS)}")
    return [sweep for sweep in SWEEPS.values() if not names or sweep.name in names]
