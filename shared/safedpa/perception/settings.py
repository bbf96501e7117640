"""What a person may set about perception; errors name the setting."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite
from typing import final

from safedpa.errors import InputError

__all__ = ["PerceptionSettings"]


@final
@dataclass(frozen=True)
class PerceptionSettings:
    """Lengths in m, times in s, speeds in m/s. Raises InputError naming the setting, what was got and wanted."""

    fastest: float = 1.5
    """Speed that anything which moves may have, in any direction, at any moment: a person who walks quickly."""
    coming: float = 1.5
    """Speed that is reckoned with for what comes out of a place that nobody sees. Less lets the robot drive faster past
    corners, and promises nothing about who comes faster."""
    slimmest: float = 0.2
    """Radius of the slimmest thing that may move: where it does not fit, nothing hides. No less than a cell of 0.1 m:
    in a cell that something slimmer is in, hardly any ray would show that it is not."""
    widest: float = 0.25
    """Radius that is reckoned with for something hidden."""
    point_radius: float = 0.05
    """Of the disc around a measured point: noise, and half of the room to its neighbours."""
    drift: float = 0.02
    """m by which the robot may misjudge its own way for each metre: what it has not seen since is wider by so much."""
    time_out: float = 0.5
    """A source that is silent for longer is told as amiss, and the filter brakes."""
    still_after: float = 0.25
    """What was never seen to move, and stays in its place for so long, is at rest: at 10 Hz, three scans."""
    restless: float = 10.0
    """What was seen to move and stops may move again for so long."""
    memory: float = 30.0
    """What is at rest is believed to be there for so long after it was seen last."""
    reach: float = 5.0
    """How far around the robot anything is remembered."""
    most: int = 160
    """Discs of each kind that are told at most: where there is more, one stands for several."""
    open_air: bool = False
    """Whether a ray that does not come back has seen free room: not so where there is glass."""

    def __post_init__(self) -> None:
        for name, low, high in (
            ("fastest", 0.0, 20.0),
            ("coming", 0.0, self.fastest),
            ("slimmest", 0.1, 5.0),
            ("widest", self.slimmest, 5.0),
            ("point_radius", 0.0, 1.0),
            ("drift", 0.0, 1.0),
            ("time_out", 0.05, 10.0),
            ("still_after", 0.0, 60.0),
            ("restless", 0.0, 600.0),
            ("memory", 0.1, 3600.0),
            ("reach", 1.0, 15.0),
            ("most", 8, 256),
        ):
            value = getattr(self, name)
            if isinstance(value, bool) or not (isfinite(value) and low <= value <= high):
                raise InputError(f"perception {name}: got {value!r}, wanted {low:g} to {high:g}")
