"""State of a work session: the stack of model versions, the candidates for each, and the user's view."""

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
from safedpa_services.workbench.session.candidate_cards import (
    CandidateCard,
    make_card,
    unexplained_sentence,
    verdict_sentence,
)
from safedpa_services.workbench.session.jobs import REMOVED, SearchResult, SessionVersion
from safedpa_services.workbench.session.selection import (
    ErrorMap,
    Selection,
    SelectionSummary,
    default_axes,
    error_map,
    summarize_selection,
)


@dataclass
class Session:
    """Versions of one model on the same recordings, the given model first, with candidates, decisions and a view."""

    title: str
    runs: Sequence[Run]
    horizon: float
    versions: list[SessionVersion]
    base: int = field(init=False)
    """Number of versions that cannot be undone: the given model and, if it has free parameters, the refitted one."""
    search_results: dict[int, SearchResult] = field(default_factory=dict)
    """Search result by the number of the version that it extends."""
    rejected: dict[int, set[str]] = field(default_factory=dict)
    selection: Selection | None = None
    start: int = 0
    """Index of the window at which the shown prediction starts."""
    shown: int | None = None
    """Number of the version that the page shows; None for the present one."""
    axes: tuple[str, str] = field(init=False)
    decisions: list[tuple[str, str, int]] = field(default_factory=list)
    """The user's decisions in order: ("added", "removed" or "rejected", effect, version number)."""

    def __post_init__(self) -> None:
        self.base = len(self.versions)
        self.axes = default_axes(self.present.comparison)
        self.start = self.worst_start()

    def view(self) -> Session:
        """A second view of this session; it shares all but selection, start, axes and shown version."""
        return copy.copy(self)

    def copy_view_settings(self, other: Session) -> None:
        """Copies selection, start, shown version and axes from another view."""
        self.selection, self.start, self.shown, self.axes = other.selection, other.start, other.shown, other.axes

    @property
    def number(self) -> int:
        """Number of the present version."""
        return len(self.versions) - 1

    @property
    def present(self) -> SessionVersion:
        """The last version."""
        return self.versions[-1]

    @property
    def shown_version(self) -> SessionVersion:
        """The version whose errors are shown."""
        return self.versions[self.number if self.shown is None else min(self.shown, self.number)]

    @property
    def comparison(self) -> Comparison:
        """Comparison of the shown version with the recordings."""
        return self.shown_version.comparison

    def start_at(self, window: int) -> None:
        """Starts the shown prediction at a window, or at the nearest one that exists."""
        self.start = max(0, min(len(self.comparison.windows) - 1, window))

    def set_axes(self, x: str, y: str) -> None:
        """Chooses the variables of the error map."""
        self.axes = (x, y)

    def show_version(self, number: int) -> None:
        """Shows version ``number``; the present version does not change."""
        self.shown = None if number == self.number else max(0, min(number, self.number))

    # candidates

    def propose(self, version: int, found: SearchResult) -> None:
        """Stores the result of the search after a version."""
        self.search_results[version] = found

    @property
    def proposed(self) -> SearchResult | None:
        """Search result for the present version; None before its search is done."""
        return self.search_results.get(self.number)

    def cards(self) -> list[CandidateCard]:
        """Cards of the candidates of the present version that were not rejected, the best first."""
        proposed, rejected = self.proposed, self.rejected.get(self.number, set())
        if proposed is None:
            return []
        return [self._card(item, proposed) for item in proposed.candidates if item.effect not in rejected]

    def _card(self, item: Candidate, proposed: SearchResult) -> CandidateCard:
        fitted_version = proposed.fitted.get(item.effect)
        own = item.effect.split(" + ")
        values = (
            {} if fitted_version is None else {k: v for k, v in fitted_version.values.items() if k.split(".")[0] in own}
        )
        after = None if fitted_version is None else fitted_version.error
        return make_card(self.present.model.system.name, item, self.present.error, after, values)

    def fitted_version(self, effect: str) -> SessionVersion | None:
        """The version with this candidate if the search has fitted it already, else None."""
        return None if self.proposed is None else self.proposed.fitted.get(effect)

    def add(self, version: SessionVersion) -> None:
        """Makes the version with an added candidate, or without a removed effect, the present one."""
        what = "removed" if version.label.startswith(REMOVED) else "added"
        self.decisions.append((what, version.label.removeprefix("+ ").removeprefix(REMOVED), self.number))
        self.versions.append(version)
        self.shown = None

    def reject(self, effect: str) -> None:
        """Removes a candidate from the list of the present version; raises InputError if it is not on the list."""
        if effect not in {card.effect for card in self.cards()}:
            raise InputError(f"effect '{effect}': not among the candidates; choose one from the list")
        self.rejected.setdefault(self.number, set()).add(effect)
        self.decisions.append(("rejected", effect, self.number))

    def undo(self) -> str:
        """Reverts the last decision and returns a message that names it; empty if there is none."""
        if not self.decisions:
            return ""
        what, effect, version = self.decisions.pop()
        if what == "rejected":
            self.rejected[version].discard(effect)
            return f"{effect} is back on the list."
        self.search_results.pop(self.number, None)
        self.rejected.pop(self.number, None)
        self.versions.pop()
        self.shown = None
        return f"{effect} is in the model again." if what == "removed" else f"{effect} was removed again."

    def doubtful_effects(self) -> tuple[str, ...]:
        """Effects of the present version whose fitted parameters lie within two deviations of no effect."""
        version, found = self.present, []
        for item in version.model.effects:
            shifts = [
                (abs(value.value - p.neutral), value.std)
                for p in item.parameters
                if p.neutral is not None and (value := version.values.get(f"{item.name}.{p.name}")) is not None
            ]
            if shifts and all(std is not None and shift <= 2.0 * std for shift, std in shifts):
                found.append(item.name)
        return tuple(found)

    # where it fails

    def map(self) -> ErrorMap:
        """Error map over the two chosen variables."""
        return error_map(self.comparison, *self.axes)

    def first_map(self) -> ErrorMap:
        """Error map of the first fitted version; it sets the colour scale of all versions."""
        return error_map(self.versions[self.base - 1].comparison, *self.axes)

    @property
    def mask(self) -> NDArray[np.bool_] | None:
        """Which windows are selected, shape (windows,); None without a selection."""
        return None if self.selection is None else self.selection.mask(self.comparison)

    @property
    def selection_summary(self) -> SelectionSummary | None:
        """What the selected windows have in common; None without a selection."""
        mask = self.mask
        return None if mask is None else summarize_selection(self.comparison, mask)

    def select(self, selection: Selection | None) -> None:
        """Selects windows, and moves the start to the worst of them if it lies outside."""
        self.selection = selection
        mask = self.mask
        if mask is not None and mask.any() and not mask[self.start]:
            self.start = self.worst_start()

    def worst_start(self) -> int:
        """Index of a window with a large finite error, among the selected windows or all: that at the 95 % quantile."""
        errors = np.where(np.isfinite(self.comparison.window_errors), self.comparison.window_errors, -1.0)
        mask = self.mask
        if mask is not None and mask.any():
            errors = np.where(mask, errors, -2.0)
        # the very worst window may be a tracking glitch; the 95 % quantile is typical of the failure
        count = len(errors) if mask is None or not mask.any() else int(mask.sum())
        order = np.argsort(-errors)
        return int(order[min(count - 1, count // 20)])

    # texts

    @property
    def verdict(self) -> str:
        """The sentence at the top of the page: where the model fails and, after the search, which effect is missing."""
        proposed = self.proposed
        if proposed is None:
            return where_sentence(self.comparison)
        cards = {card.effect: card for card in self.cards()}
        rest = proposed.unexplained
        why_not = rest.expression if rest is not None and not rest.depends_on else ""
        if proposed.choice is not None and proposed.choice not in cards:
            return f"You rejected {proposed.choice}; the other candidates gain less. {where_sentence(self.comparison)}"
        choice = cards.get(proposed.choice) if proposed.choice else None
        sentence = verdict_sentence(choice, self.present.error, why_not)
        return f"{sentence} {unexplained_sentence(rest)}".strip()
