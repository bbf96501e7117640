"""One number of a model: its unit, the range in which it is physical, and how large it usually is."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Parameter"]


@dataclass(frozen=True)
class Parameter:
    """A named number of a base model or an effect.

    ``neutral`` is the value at which an effect does nothing; None for a number that only shapes it, such as the speed
    at which a friction law fades. For a base model it is the value that is assumed when none is given, or None where
    one must be given. ``typical`` is the size at which the effect is ordinary: the scale on which fits and random
    draws work, and where a number without a neutral value starts.

    Raises ValueError when the bounds are empty or typical and neutral do not lie within them.
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
        if self.neutral is not None and not self.low <= self.neutral <= self.high:
            raise ValueError(f"{self.name}: neutral {self.neutral} lies outside {self.low} to {self.high}")

    @property
    def start(self) -> float:
        """Where a fit starts: the neutral value, or the typical one where there is none."""
        return self.typical if self.neutral is None else self.neutral
