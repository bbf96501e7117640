"""The interface of an attack: pieces of work for several processes, and rows of measured values with their limits."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, final


@final
@dataclass(frozen=True)
class Row:
    """One measured value with its limits ``most`` and ``least``; without limits it is only reported."""

    what: str
    measured: float
    of: int | None = None
    """Size of the sample, if the value is a count."""
    most: float | None = None
    least: float | None = None
    unit: str = ""

    @property
    def held(self) -> bool | None:
        """Whether the value is within its limits; None without limits, or with an empty sample."""
        if (self.most is None and self.least is None) or self.of == 0:
            return None
        low = -float("inf") if self.least is None else self.least
        high = float("inf") if self.most is None else self.most
        return low <= self.measured <= high

    @property
    def asked(self) -> str:
        """The limits as text."""
        if self.most is None and self.least is None:
            return ""
        if self.most is not None and self.least is not None:
            return f"{self.least:g} to {self.most:g} {self.unit}".strip()
        phrase = f"at most {self.most:g}" if self.most is not None else f"at least {self.least:g}"
        return f"{phrase} {self.unit}".strip()

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "what": self.what,
            "measured": self.measured,
            "of": self.of,
            "asked": self.asked,
            "unit": self.unit,
            "held": self.held,
        }


@final
@dataclass(frozen=True)
class Result:
    """The rows of one attack, and its worst cases with all that is needed to repeat them."""

    rows: Sequence[Row]
    worst: Sequence[dict[str, Any]] = ()


class AbstractAttack(ABC):
    """``pieces`` are divided among processes, ``work`` answers one of them, ``reported`` makes rows of all answers.

    Everything that travels is picklable; the same seed gives the same pieces, whatever the number of processes.
    """

    name: str
    sentence: str

    @abstractmethod
    def pieces(self, seed: int, small: bool) -> Sequence[Any]:
        """What is to be done; ``small`` takes seconds."""

    @abstractmethod
    def work(self, piece: Any) -> Any:
        """The answer to one piece."""

    @abstractmethod
    def reported(self, answers: Sequence[Any]) -> Result:
        """Rows and worst cases of all answers, in the order of their pieces."""


@final
class WholeAttack(AbstractAttack):
    """An attack that another experiment carries out as a whole: ``run(seed, small) -> Result``, one piece."""

    def __init__(self, name: str, sentence: str, run: Callable[[int, bool], Result]) -> None:
        self.name, self.sentence, self._run = name, sentence, run

    def pieces(self, seed: int, small: bool) -> Sequence[Any]:  # noqa: D102
        return [(seed, small)]

    def work(self, piece: Any) -> Result:  # noqa: D102
        return self._run(*piece)

    def reported(self, answers: Sequence[Any]) -> Result:  # noqa: D102
        rows = [row for answer in answers for row in answer.rows]
        return Result(rows, [case for answer in answers for case in answer.worst])
