"""One number of a model: its unit, the range in which it is physical, and how large it usually is."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Parameter"]


@dataclass(frozen=True)
class Parameter:
    """A named number of a base model or an effect.

    ``neutral`` is the value at which an effect does nothing (for a base model: the value that is assumed when
    none is given, or None where one must be given). ``typical`` is the size at which the effect is ordinary: the
    scale on which fits and random draws work.
    """

    name: str
    unit: str
    low: float
    high: float
    typical: float
    neutral: float | None = 0.0
    meaning: str = ""

    def __post_init__(self) -> None:
        if not self.low < self.high:
            raise ValueError(f"{self.name}: got bounds {self.low} to {self.high}, wanted low < high")
        if not self.low <= self.typical <= self.high:
            raise ValueError(f"{self.name}: typical {self.typical} lies outside {self.low} to {self.high}")
