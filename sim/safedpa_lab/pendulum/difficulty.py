"""How hard the pendulum's questions are made, and the episodes that are drawn for one difficulty."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import degrees, pi, radians
from typing import Final, final

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray
from safedpa.errors import InputError
from safedpa.safety import FilterSettings
from safedpa_sim.pendulum.policy_task import starts_beneath
from safedpa_sim.pendulum.task import BALANCING, HAZARD, TORQUE, WIND, filter_settings

_START = 0.2
"""rad; largest angle at the start of the first question, at rest."""


@final
@dataclass(frozen=True)
class Difficulty:
    """One degree of difficulty of both questions; what is not given is as everywhere else in the experiment."""

    wind: float = WIND
    """m/s."""
    torque: float = TORQUE
    """N m; bound of the motor, which the filter knows."""
    corridor: float = BALANCING[1]
    """rad; half of the safe angles of the first question."""
    hazard: float = HAZARD[0]
    """rad; where the hazard of the second question begins behind upright. It ends where it always does."""
    noise: float = 0.0
    """Standard deviation of what the sensors add in every period: rad to the angle, rad/s to the rate."""

    def __post_init__(self) -> None:
        if min(self.wind, self.noise) < 0.0 or min(self.torque, self.corridor, self.hazard) <= 0.0:
            raise InputError(f"difficulty: got {self}, wanted wind and noise of 0 or more, the others above 0")
        if self.hazard >= HAZARD[1]:
            raise InputError(f"hazard: got it from {self.hazard:.3f} rad on, wanted below its end, {HAZARD[1]:.3f}")

    @property
    def balancing(self) -> tuple[float, float]:
        """The edges [rad] of the first question."""
        return -self.corridor, self.corridor

    @property
    def long_way_round(self) -> tuple[float, float]:
        """The edges [rad] of the second question: what is left of the circle next to the hazard."""
        return HAZARD[1], self.hazard + 2.0 * pi

    def settings(self, epsilon: float) -> FilterSettings:
        """The filter's, with a margin [rad]."""
        return filter_settings(epsilon, torque=self.torque)

    def in_hazard(self, angle: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Whether angles are in the hazard, whatever the number of turns."""
        within = np.mod(angle, 2.0 * pi)
        inside: NDArray[np.bool_] = (within > self.hazard) & (within < HAZARD[1])
        return inside


@final
@dataclass(frozen=True)
class Episodes:
    """Which episodes: the same winds, starts, draws and sensor noise for every method that is given them."""

    seed: int
    directions: int
    episodes: int
    """Of each direction."""
    difficulty: Difficulty = field(default_factory=Difficulty)
    anywhere: bool = False
    """The wind of each episode blows to a direction of its own, drawn at random; else evenly around."""

    @property
    def count(self) -> int:
        """All of them, direction by direction."""
        return self.directions * self.episodes

    def winds(self) -> FloatArray:
        """(count, 2) as speed and upward [m/s]."""
        angle = np.repeat(2 * np.pi * np.arange(self.directions) / self.directions, self.episodes)
        if self.anywhere:
            angle = self.random(20).uniform(0.0, 2 * np.pi, self.count)
        return self.difficulty.wind * np.stack((np.cos(angle), np.sin(angle)), axis=1)

    def upright_starts(self) -> FloatArray:
        """(count, 2) near upright, at rest: the first question's."""
        start = np.zeros((self.count, 2))
        start[:, 0] = self.random(21).uniform(-_START, _START, self.count)
        return start

    def starts_beneath(self) -> FloatArray:
        """(count, 2) just beneath the hazard, moving towards it: the second question's."""
        return starts_beneath(self.count, self.random(23))

    def random(self, stream: int) -> np.random.Generator:
        """A generator of one of the streams of the seed."""
        return np.random.default_rng([self.seed, stream])


@final
@dataclass(frozen=True)
class Axis:
    """One number of ``Difficulty`` that is made harder step by step."""

    name: str
    label: str
    values: tuple[float, ...]
    questions: tuple[int, ...] = (1, 2)
    shown: tuple[float, ...] = ()
    """The values as they stand under a figure; empty: as they are."""

    def at(self, value: float) -> Difficulty:
        """The difficulty with this number changed alone."""
        return Difficulty(**{self.name: value})

    @property
    def ticks(self) -> tuple[float, ...]:
        """What stands beneath each value."""
        return self.shown or self.values


def _in_degrees(values: tuple[float, ...]) -> tuple[float, ...]:
    return tuple(round(degrees(value), 3) for value in values)


_CORRIDORS: Final = tuple(radians(angle) for angle in (60.0, 45.0, 20.0, 8.0))
_HAZARDS: Final = tuple(radians(angle) for angle in (20.0, 10.0, 5.0, 1.0))
AXES: Final = (
    Axis("wind", "wind [m/s]", (2.0, 3.0, 4.0, 4.5, 5.0)),
    Axis("torque", "torque bound [N m]", (12.0, 10.0, 9.0, 8.0, 7.0)),
    Axis("corridor", "edges [degrees]", _CORRIDORS, (1,), _in_degrees(_CORRIDORS)),
    Axis("hazard", "hazard from [degrees]", _HAZARDS, (2,), _in_degrees(_HAZARDS)),
    Axis("noise", "sensor noise [rad and rad/s]", (0.0, 0.003, 0.01, 0.03, 0.1)),
)
"""Each from easy to hard, with the experiment's own value among them."""
