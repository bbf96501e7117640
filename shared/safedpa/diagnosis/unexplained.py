"""What no effect of the library explains, as plain data: on what it depends, a map of it, a formula that fits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

__all__ = ["Dependence", "FormulaTerm", "Profile", "RateMap", "Unexplained"]


@dataclass(frozen=True)
class FormulaTerm:
    """d(state)/dt += coefficient term."""

    state: str
    term: str
    coefficient: float
    std: float | None
    """One standard deviation."""
    unit: str


@dataclass(frozen=True)
class Dependence:
    """How much of what remains any function of one variable tells, fitted without the blocks that it predicts."""

    variable: str
    state: str
    """Whose rate remains."""
    share: float
    """Of the squares of the residual, noise included."""
    standard_errors: float
    """Of that gain, over independent blocks of time."""


@dataclass(frozen=True)
class Profile:
    """The function of one variable that the rate of a state lacks, by its values at some knots, straight between."""

    variable: str
    unit: str
    state: str
    rate_unit: str
    knots: tuple[float, ...]
    values: tuple[float, ...]
    errors: tuple[float, ...]
    """One standard deviation of each value."""
    formula: tuple[float, ...] | None
    """What the formula gives at the knots, where it depends on this variable alone."""
    rows: tuple[int, ...] = ()
    """Measured rows between the neighbours of each knot."""


@dataclass(frozen=True)
class RateMap:
    """Mean remaining rate in cells of two variables; rows go up, None where a cell has too few windows."""

    across: str
    across_unit: str
    up: str
    up_unit: str
    state: str
    rate_unit: str
    across_edges: tuple[float, ...]
    up_edges: tuple[float, ...]
    means: tuple[tuple[float | None, ...], ...]
    windows: tuple[tuple[int, ...], ...]


@dataclass(frozen=True)
class Unexplained:
    """Structure of what remains that no effect of the library has."""

    depends_on: tuple[str, ...]
    expression: str
    """A formula that fits, not an effect; where nothing could be judged, why not."""
    share: float
    """Of the remaining squared error."""
    kind: Literal["place", "formula", "dependence", "no_verdict"] = "no_verdict"
    terms: tuple[FormulaTerm, ...] = ()
    alternatives: tuple[str, ...] = ()
    """Terms that unseen blocks cannot tell from the formula's first."""
    dependence: tuple[Dependence, ...] = ()
    """Every variable that was looked at, the one that tells most first."""
    profile: Profile | None = None
    map: RateMap | None = None
