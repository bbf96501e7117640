"""What a check of a filter found: sentences, none where all is well."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, final, overload

__all__ = ["FilterIssue", "FilterReport", "gathered", "shown"]


@final
@dataclass(frozen=True)
class FilterIssue:
    """One thing that does not hold: ``subject`` is what it is about, ``sentence`` what was got, wanted, and to do."""

    subject: str
    """``failure``, ``margin``, ``scale``, ``relative degree``, ``conditions``, ``backup``, ``horizon``, ``ticks`` or
    ``gradient``."""
    names: tuple[str, ...]
    """Of the barriers concerned, if it concerns some."""
    sentence: str

    def __str__(self) -> str:
        of = f" ({', '.join(self.names[:4])}{', ...' if len(self.names) > 4 else ''})" if self.names else ""
        return f"{self.subject}{of}: {self.sentence}"


@final
class FilterReport(Sequence[FilterIssue]):
    """All issues; empty, and so false, where none was found."""

    def __init__(self, issues: Sequence[FilterIssue], states: int) -> None:
        self.issues, self.states = tuple(issues), states
        """``states``: how many were probed."""

    @property
    def subjects(self) -> set[str]:
        """What the issues are about."""
        return {issue.subject for issue in self.issues}

    def __len__(self) -> int:
        return len(self.issues)

    @overload
    def __getitem__(self, index: int) -> FilterIssue: ...

    @overload
    def __getitem__(self, index: slice) -> tuple[FilterIssue, ...]: ...

    def __getitem__(self, index: int | slice) -> FilterIssue | tuple[FilterIssue, ...]:
        return self.issues[index]

    def __iter__(self) -> Iterator[FilterIssue]:
        return iter(self.issues)

    def __str__(self) -> str:
        if not self.issues:
            return f"Nothing amiss at {self.states} states."
        return "\n".join(f"- {issue}" for issue in self.issues)


def gathered(subject: str, names: Sequence[str], cases: Mapping[int, tuple[float, str]]) -> list[FilterIssue]:
    """One issue about all rows of ``cases`` (how bad, sentence), or none: the sentence of the worst, named first."""
    order = sorted(cases, key=lambda row: -cases[row][0])
    return [FilterIssue(subject, tuple(names[row] for row in order), cases[order[0]][1])] if order else []


def shown(numbers: Any) -> str:
    """A state or an action in a sentence."""
    return "[" + ", ".join(f"{entry:.4g}" for entry in numbers) + "]"
