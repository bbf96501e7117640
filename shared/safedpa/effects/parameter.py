"""The declaration of a parameter: its unit, its physical range, and its usual size."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Parameter:
    """A named parameter of a base model or an effect.

    ``neutral`` is the value at which an effect does nothing; None for a parameter that only shapes it, such as the
    speed at which a friction law fades. For a base model it is the default, or None if a value must be given.
    ``typical`` is the usual size of the parameter: the scale of fits and random draws, and the start of a fit if there
    is no neutral value.

    Raises ValueError if the bounds are empty, or typical or neutral lies outside them.
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
        """Where a fit starts: the neutral value, or the typical one if there is none."""
        return self.typical if self.neutral is None else self.neutral
