"""The workbench without its page: the stack of model versions, what is proposed for each, and what is looked at."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from safedpa.comparison.comparison import Comparison
from safedpa.comparison.summary import where_sentence
from safedpa.diagnosis.report_schema import Candidate
from safedpa.errors import InputError
from safedpa.records.run import Run
from safedpa_services.workbench.brush import (
    Brush,
    ErrorMap,
    SelectionSummary,
    default_axes,
    error_map,
    summarize_selection,
)
from safedpa_services.workbench.evidence import CandidateCard, card_of, rest_sentence, verdict_sentence
from safedpa_services.workbench.jobs import SearchResult, SessionVersion

__all__ = ["Session"]


@dataclass
class Session:
    """What one engineer has before them: versions of a model, the given one first, over the same recordings."""

    title: str
    runs: Sequence[Run]
    horizon: float
    versions: list[SessionVersion]
    base: int = field(init=False)
    """Versions that cannot be undone: the given model and the refitted one."""
    found: dict[int, SearchResult] = field(default_factory=dict)
    """By the number of the version after which it was searched."""
    rejected: dict[int, set[str]] = field(default_factory=dict)
    brush: Brush | None = None
    start: int = 0
    """Number of the window that is shown."""
    shown: int | None = None
    """Number of the version that is looked at; None: the present one."""
    axes: tuple[str, str] = field(init=False)
    decided: list[tuple[str, str, int]] = field(default_factory=list)
    """What the engineer did, the last last: ("added" or "rejected", effect, version)."""

    def __post_init__(self) -> None:
        self.base = len(self.versions)
        self.axes = default_axes(self.present.comparison)
        self.start = self.worst_start()

    def view(self) -> Session:
        """The same session, looked at in another way: versions, candidates and decisions are shared, the eye is not."""
        return copy.copy(self)

    def take_eye(self, other: Session) -> None:
        """Looks at what another view looks at."""
        self.brush, self.start, self.shown, self.axes = other.brush, other.start, other.shown, other.axes

    @property
    def number(self) -> int:
        """Number of the present version."""
        return len(self.versions) - 1

    @property
    def present(self) -> SessionVersion:
        """The last version."""
        return self.versions[-1]

    @property
    def looked_at(self) -> SessionVersion:
        """The version whose errors are shown."""
        return self.versions[self.number if self.shown is None else min(self.shown, self.number)]

    @property
    def comparison(self) -> Comparison:
        """That of the version that is looked at."""
        return self.looked_at.comparison

    def look_at(self, number: int) -> None:
        """Shows an earlier version; the present one goes on."""
        self.shown = None if number == self.number else max(0, min(number, self.number))

    # candidates

    def propose(self, version: int, found: SearchResult) -> None:
        """Takes the result of a search after a version."""
        self.found[version] = found

    @property
    def proposed(self) -> SearchResult | None:
        """What was found after the present version; None before its search is done."""
        return self.found.get(self.number)

    def cards(self) -> list[CandidateCard]:
        """The candidates of the present version that were not rejected, the best first."""
        proposed, gone = self.proposed, self.rejected.get(self.number, set())
        if proposed is None:
            return []
        return [self._card(item, proposed) for item in proposed.candidates if item.effect not in gone]

    def _card(self, item: Candidate, proposed: SearchResult) -> CandidateCard:
        settled = proposed.settled.get(item.effect)
        own = item.effect.split(" + ")
        values = {} if settled is None else {k: v for k, v in settled.values.items() if k.split(".")[0] in own}
        after = None if settled is None else settled.error
        return card_of(self.present.model.system.name, item, self.present.error, after, values)

    def settled(self, effect: str) -> SessionVersion | None:
        """The version with a candidate, where it was fitted to the end already."""
        return None if self.proposed is None else self.proposed.settled.get(effect)

    def add(self, version: SessionVersion) -> None:
        """Goes on with a candidate."""
        self.decided.append(("added", version.label.removeprefix("+ "), self.number))
        self.versions.append(version)
        self.shown = None

    def reject(self, effect: str) -> None:
        """Takes a candidate off the list of the present version.

        Raises InputError where it is not on the list.
        """
        if effect not in {card.effect for card in self.cards()}:
            raise InputError(f"effect '{effect}': not among the candidates; choose one of the list")
        self.rejected.setdefault(self.number, set()).add(effect)
        self.decided.append(("rejected", effect, self.number))

    def undo(self) -> str:
        """Takes the last decision back and says which one; empty where there is none."""
        if not self.decided:
            return ""
        what, effect, version = self.decided.pop()
        if what == "rejected":
            self.rejected[version].discard(effect)
            return f"{effect} is back on the list."
        self.found.pop(self.number, None)
        self.rejected.pop(self.number, None)
        self.versions.pop()
        self.shown = None
        return f"{effect} is taken out again."

    # where it fails

    def map(self) -> ErrorMap:
        """The error over the two chosen variables."""
        return error_map(self.comparison, *self.axes)

    def first_map(self) -> ErrorMap:
        """The same of the first version that was fitted: the scale of the colours."""
        return error_map(self.versions[self.base - 1].comparison, *self.axes)

    @property
    def mask(self) -> NDArray[np.bool_] | None:
        """The selected windows; None where nothing is selected."""
        return None if self.brush is None else self.brush.mask(self.comparison)

    @property
    def inside(self) -> SelectionSummary | None:
        """What the selected windows have in common."""
        mask = self.mask
        return None if mask is None else summarize_selection(self.comparison, mask)

    def select(self, brush: Brush | None) -> None:
        """Draws a box around some windows, and shows the worst of them."""
        self.brush = brush
        mask = self.mask
        if mask is not None and mask.any() and not mask[self.start]:
            self.start = self.worst_start()

    def worst_start(self) -> int:
        """The window with the largest finite error among the selected ones, or among all."""
        errors = np.where(np.isfinite(self.comparison.window_errors), self.comparison.window_errors, -1.0)
        mask = self.mask
        if mask is not None and mask.any():
            errors = np.where(mask, errors, -2.0)
        # the worst one may be a glitch of the tracking: the worst of the lower 95 % is typical of what fails
        count = len(errors) if mask is None or not mask.any() else int(mask.sum())
        order = np.argsort(-errors)
        return int(order[min(count - 1, count // 20)])

    # sentences

    @property
    def verdict(self) -> str:
        """The sentence on top: where the model fails, and once the search is done, what is missing."""
        proposed = self.proposed
        if proposed is None:
            return where_sentence(self.comparison)
        cards = {card.effect: card for card in self.cards()}
        rest = proposed.unexplained
        why_not = rest.expression if rest is not None and not rest.depends_on else ""
        if proposed.choice is not None and proposed.choice not in cards:
            return f"{proposed.choice} was rejected by you; the others gain less. {where_sentence(self.comparison)}"
        choice = cards.get(proposed.choice) if proposed.choice else None
        sentence = verdict_sentence(choice, self.present.error, why_not)
        return f"{sentence} {rest_sentence(rest)}".strip()
