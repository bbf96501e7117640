"""The result of a check of a filter: one sentence per issue, none if all is well."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, final, overload

__all__ = ["FilterIssue", "FilterReport", "collect", "format_vector"]


from safedpa.result import one_line


@final
@dataclass(frozen=True)
class FilterIssue:
    """One issue: its ``subject``, and a ``sentence`` with what was got, what was wanted and what to do."""

    subject: str
    """``failure``, ``margin``, ``scale``, ``relative degree``, ``conditions``, ``stall``, ``backup``, ``lost state``,
    ``horizon``, ``ticks``, ``flat``, ``gradient`` or ``time``."""
    names: tuple[str, ...]
    """Names of the barriers concerned, if any."""
    sentence: str

    def __str__(self) -> str:
        # Four names identify the cause; a scene may have hundreds of rows.
        of = f" ({', '.join(self.names[:4])}{', ...' if len(self.names) > 4 else ''})" if self.names else ""
        return f"{self.subject}{of}: {self.sentence}"


@final
class FilterReport(Sequence[FilterIssue]):
    """All issues; empty, and so false, if none was found. ``print(report)`` lists them.

    ``states`` is the number of states that were probed; ``notes`` are remarks that are no issues, such as the line that
    prevents a barrier from being compiled. See ``check_filter``.

    Example:

        >>> model, settings = safedpa.load_model("pendulum"), safedpa.FilterSettings.for_robot("pendulum", epsilon=0.0)
        >>> safe = safedpa.SafetyFilter.for_model(model, settings, [safedpa.CorridorBarrier(-0.3, 0.3, 0.25)])
        >>> report = safedpa.check_filter(safe, [0.0, 0.0], latent=model.latent, can_stop=False)
        >>> sorted(report.subjects)
        ['margin']
    """

    def __init__(self, issues: Sequence[FilterIssue], states: int, notes: Sequence[str] = ()) -> None:
        self.issues, self.states, self.notes = tuple(issues), states, tuple(notes)
        """``states``: number of states that were probed."""

    def __repr__(self) -> str:
        return one_line("FilterReport", {"states": self.states, "issues": ", ".join(sorted(self.subjects)) or "none"})

    @property
    def subjects(self) -> set[str]:
        """The subjects of all issues."""
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
        # The number of states shows how much the absence of issues means.
        if not self.issues:
            return "\n".join([f"No issue at {self.states} states.", *self.notes])
        return "\n".join([*(f"- {issue}" for issue in self.issues), *self.notes])


def collect(subject: str, names: Sequence[str], cases: Mapping[int, tuple[float, str]]) -> list[FilterIssue]:
    """At most one issue about all rows of ``cases`` (severity, sentence): the sentence and name of the worst first."""
    # One sentence instead of one for each row: a wrong unit usually affects all rows of a kind.
    order = sorted(cases, key=lambda row: -cases[row][0])
    return [FilterIssue(subject, tuple(names[row] for row in order), cases[order[0]][1])] if order else []


def format_vector(numbers: Any) -> str:
    """A state or an action as text."""
    return "[" + ", ".join(f"{entry:.4g}" for entry in numbers) + "]"
