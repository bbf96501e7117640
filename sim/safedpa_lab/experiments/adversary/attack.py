"""The interface of an attack, rows of measured values with their limits, and answers compared with a grid."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, final

import numpy as np

from safedpa.arrays import BoolArray, FloatArray

BROKEN: Final = 1e-9
"""Share of its scale by which a condition is broken beyond rounding."""
FAR: Final = 0.1
"""Ranges by which a correction is further away than the nearest action of a grid."""
CLOSE: Final = 0.01
"""Share of the scale within which the least-violation action counts as such."""


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
        if self.most is not None and self.least is not None:
            return f"{self.least:g} to {self.most:g} {self.unit}".strip()
        if self.most is None and self.least is None:
            return ""
        limit = f"at most {self.most:g}" if self.most is not None else f"at least {self.least:g}"
        return f"{limit} {self.unit}".strip()

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {name: getattr(self, name) for name in ("what", "measured", "of", "asked", "unit", "held")}


@final
@dataclass(frozen=True)
class Result:
    """The rows of one attack, and its worst cases with all that is needed to repeat them."""

    rows: Sequence[Row]
    worst: Sequence[dict[str, Any]] = ()


@final
@dataclass(frozen=True, kw_only=True)
class Judged:
    """What was wrong with one answer of the filter; None where a question does not arise."""

    status: str
    number: int = -1
    """Of the problem, which is drawn again from it."""
    shape: str = ""
    out_of_bounds: bool = False
    altered: bool = False
    """Passed, but not the nominal action bit for bit."""
    broken: float | None = None
    """Passed or corrected: by how much the worst condition is broken, in its scale; 0 when all are kept."""
    below: bool = False
    """Passed or corrected, and some predicted h is below 0."""
    untold: bool = False
    """Some h is below 0 now, and the status is not violated; or the other way round."""
    excess: float | None = None
    """Corrected: weighted distance from the nominal action beyond the least, in ranges."""
    missed: bool = False
    """Relaxed or fallback, though an action satisfies every condition with room."""
    shortfall: float | None = None
    """Relaxed, violated or fallback: least scaled h left, against the best attainable."""
    needless: bool = False
    """Relaxed or fallback predicts h < 0, where an action with all h >= 0 exists."""

    @property
    def undecided(self) -> bool:
        """Raised an exception, or nothing was computed."""
        return self.status.startswith("raised") or self.status == "fallback"


@final
class Answers:
    """Many judged answers: the sizes of their faults, and how often they occur."""

    def __init__(self, items: Iterable[Judged]) -> None:
        self.items = list(items)
        self.broken = [item.broken for item in self.items if item.broken is not None]
        self.excess = [item.excess for item in self.items if item.excess is not None]
        self.shortfall = [item.shortfall for item in self.items if item.shortfall is not None]
        self.rest = sum(item.broken is None for item in self.items)
        """Answers that are neither passed nor corrected."""

    def count(self, fault: str) -> int:
        """Answers with this fault, the name of a field."""
        return sum(getattr(item, fault) for item in self.items)

    def statuses(self, before: str = "") -> list[Row]:
        """A row for each status."""
        counts = Counter(item.status for item in self.items)
        return [Row(f"{before}answers {status}", count) for status, count in sorted(counts.items())]

    def too_far(self, name: str, most: float | None) -> Row:
        """Per cent of the corrections that are ``FAR`` further away than the nearest of the grid."""
        far = 100.0 * sum(value > FAR for value in self.excess) / max(1, len(self.excess))
        return Row(f"{name}: corrected 0.1 of a range beyond the grid", far, len(self.excess), most=most, unit="%")

    def worst(self, faults: Mapping[str, Callable[[Judged], float | None]]) -> list[dict[str, Any]]:
        """The three largest of each fault, whose size is None or 0 where there is none; the higher number first."""
        found = []
        for fault, size_of in faults.items():
            cases = [(size, item.number, item.shape) for item in self.items if (size := size_of(item))]
            found += [
                {"fault": fault, "size": size, "number": number, "shape": shape, "count": len(cases)}
                for size, number, shape in sorted(cases, reverse=True)[:3]
            ]
        return found


def above(size: float | None, limit: float) -> float | None:
    """The size of a fault that counts above a limit."""
    return size if size is not None and size > limit else None


def action_grid(low: Sequence[float], high: Sequence[float], counts: Sequence[int]) -> FloatArray:
    """All combinations (n, actions) of evenly spaced actions."""
    sides = [np.linspace(*ends) for ends in zip(low, high, counts, strict=True)]
    return np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, len(sides))


def judged_on_grid(
    status: str,
    own: tuple[FloatArray, FloatArray],
    grid: tuple[FloatArray, FloatArray],
    required: FloatArray,
    scale: FloatArray,
    far: Callable[[FloatArray], FloatArray],
    **known: Any,
) -> Judged:
    """An answer, its action and predicted h (rows,) being ``own``, next to a grid of actions and their h (n, rows).

    ``far``: the distance of actions (n, actions) from the nominal one. ``known``: further fields; ``below`` counts only
    where the answer is passed or corrected.
    """
    (action, own_h), (actions, h), below = own, grid, known.pop("below")
    keeping: BoolArray = np.all((h - required) / scale >= BROKEN, axis=1)
    finite = bool(np.isfinite(own_h).all())
    if status in ("passed", "corrected"):
        broken = max(0.0, -float(((own_h - required) / scale).min())) if finite else float("inf")
        excess = None
        if status == "corrected" and keeping.any():
            excess = float(far(action[None])[0] - far(actions[keeping]).min())
        return Judged(status=status, broken=broken, below=below, excess=excess, **known)
    height = float((own_h / scale).min()) if finite else -float("inf")
    best, could = float((h / scale).min(axis=1).max()), status != "violated"
    return Judged(
        status=status,
        missed=could and bool(keeping.any()),
        shortfall=max(0.0, best - height),
        needless=could and height < -BROKEN and bool((h >= 0.0).all(axis=1).any()),
        **known,
    )


def notice_of(statuses: Mapping[str, int]) -> str:
    """Verdicts as text: "corrected 12.5 %, passed 87.5 %"."""
    seen = max(1, sum(statuses.values()))
    return ", ".join(f"{status} {100 * count / seen:.1f} %" for status, count in sorted(statuses.items()))


def pieces_of(seed: int, count: int, size: int) -> list[tuple[int, int, int]]:
    """Problems 0 to ``count`` in pieces of this size: seed, first number, and the number after the last."""
    return [(seed, first, min(first + size, count)) for first in range(0, count, size)]


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
