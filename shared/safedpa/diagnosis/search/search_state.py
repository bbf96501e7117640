"""The state of a search: its windows, the current model, and all trials with their verdicts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

from safedpa.diagnosis.fit.cross_validation import Heldout, HeldoutError, error_with
from safedpa.diagnosis.fit.least_squares import Fit, fit, relinearized
from safedpa.diagnosis.fit.multiple_shooting import Shooting
from safedpa.diagnosis.fit.trial import EffectTrial, trial_of
from safedpa.diagnosis.report_schema import Remainder
from safedpa.diagnosis.search.regions import RegionFit
from safedpa.dynamics import PhysicsModel
from safedpa.effects import AbstractEffect


@dataclass(frozen=True)
class JudgedTrial:
    """A trial with its verdict."""

    stage: int
    trial: EffectTrial
    gain: float
    """Gain on unseen blocks, in standard errors."""
    error: HeldoutError | None
    decision: str
    reason: str
    equals: tuple[str, ...]
    before: float = float("nan")
    """Held-out error of the model without it."""

    @property
    def fall(self) -> float | None:
        """Relative reduction of the held-out error; None if that was not computed."""
        return None if self.error is None or not self.before > 0 else 1.0 - self.error.value / self.before


RemainderJudge = Callable[[EffectTrial, Shooting], Remainder | None]
"""Returns what a fitted model leaves of unseen data; None if the recordings are too short to judge that."""


def no_remainder(_trial: EffectTrial, _shooting: Shooting) -> None:
    """Judges nothing; a function with a name, because a search is pickled."""


@dataclass
class SearchState:
    """What a search has found, and everything that it tried."""

    shooting: Shooting
    current: EffectTrial
    error: HeldoutError
    first: EffectTrial
    first_error: HeldoutError
    heldout: Heldout
    """Windows whose held-out error decides."""
    library: Sequence[AbstractEffect] = ()
    """Effects that the search may add."""
    given: PhysicsModel | None = None
    """The model as the user gave it, before its free parameters were refitted."""
    first_shooting: Shooting | None = None
    """The windows about the first model."""
    raw: Shooting | None = None
    """The windows with measured starts and uniform weights, about no model."""
    judge: RemainderJudge = no_remainder
    """Judges what a model leaves of unseen data."""
    least_errors: dict[int, float] = field(default_factory=dict)
    """By number of accepted effects, the lowest held-out error of a model on the way."""
    candidates: list[JudgedTrial] = field(default_factory=list)
    added: list[str] = field(default_factory=list)
    region: RegionFit | None = None
    rivals: dict[str, list[str]] = field(default_factory=dict)
    """For each accepted effect the other effects of its stage, best first."""
    without: dict[str, tuple[EffectTrial, HeldoutError]] = field(default_factory=dict)
    """For each accepted effect the fitted model of all others, if there are two or more."""
    # Exchanges, removals and merges try overlapping sets of effects, so the same fit is often requested again.
    refits: dict[tuple[AbstractEffect, ...], EffectTrial] = field(default_factory=dict, init=False)
    """Cache of models with other effects, fitted from the values of the current model."""
    refits_of: EffectTrial | None = field(default=None, init=False)
    """The current model when the cache was filled; another one makes it stale."""

    @property
    def measured(self) -> Shooting:
        """The windows about no model; those about the first model if the former are unknown."""
        return self.shooting if self.raw is None else self.raw

    @property
    def available(self) -> list[AbstractEffect]:
        """Effects of the library that the current model does not have."""
        have = {item.name for item in self.current.fit.model.effects}
        return [item for item in self.library if item.name not in have]

    def error_of(self, fitted: Fit) -> HeldoutError:
        """Returns the held-out error of a model that was fitted in the windows of the search."""
        return error_with(fitted, self.shooting, self.heldout)

    def set_model(self, fitted: Fit, shooting: Shooting) -> None:
        """Continues with a fit and the windows about which it is linearised."""
        self.shooting, self.current = shooting, trial_of(fitted, shooting, (), None)
        self.error = self.error_of(fitted)

    @property
    def between_rows(self) -> bool:
        """Whether commands change between the rows of the recordings."""
        return self.shooting.recorded is not None

    def set_timing(self, *, between_rows: bool) -> None:
        """Continues with commands that change at rows or between them, and the models fitted to these."""
        self.heldout = self.heldout.with_commands(between_rows=between_rows)
        self.raw = None if self.raw is None else self.raw.with_commands(between_rows=between_rows)
        windows = (self.first_shooting or self.shooting).with_commands(between_rows=between_rows)
        first = fit(self.first.fit.model, self.first.fit.paths, windows, self.first.fit.scale)
        self.first, self.first_shooting = trial_of(first, windows, (), None), windows
        self.first_error = error_with(first, windows, self.heldout)
        self.set_model(*relinearized(self.current.fit, self.shooting.with_commands(between_rows=between_rows)))

    def copy(self) -> SearchState:
        """Returns a search that may be continued without changing this one."""
        return replace(
            self,
            candidates=list(self.candidates),
            added=list(self.added),
            rivals=dict(self.rivals),
            without=dict(self.without),
            least_errors=dict(self.least_errors),
        )

    def restarted(self) -> SearchState:
        """Returns a search that begins with the first model again."""
        windows, error = self.first_shooting or self.shooting, self.first_error
        start = SearchState(windows, self.first, error, self.first, error, self.heldout, self.library)
        return replace(start, given=self.given, raw=self.raw, first_shooting=windows, judge=self.judge)

    def note_error(self) -> None:
        """Remembers the error of the current model by its number of accepted effects."""
        count = len(self.added)
        self.least_errors[count] = min(self.error.value, self.least_errors.get(count, float("inf")))

    def continue_from(self, other: SearchState) -> None:
        """Continues from the state of another search."""
        # ``refits`` belongs to the old current model.
        for name in (
            "shooting", "current", "error", "candidates", "added", "region", "rivals", "without", "least_errors",
            "first", "first_error", "heldout", "first_shooting", "raw",
        ):  # fmt: skip
            setattr(self, name, getattr(other, name))


def accept_trial(search: SearchState, best: EffectTrial) -> None:
    """Adds a trial to the search and fits it to convergence, because the next stage is compared with its error."""
    search.added += [name for name in best.effects if name not in search.added]
    search.set_model(*relinearized(best.fit, search.shooting))


def given_effect_names(search: SearchState) -> set[str]:
    """Returns the names of the effects of the model that the user gave."""
    return {item.name for item in search.first.fit.model.effects}


def known_effects(search: SearchState) -> dict[str, AbstractEffect]:
    """Returns effects by name: those of the current model with their laws, the others plain."""
    return {item.name: item for item in (*search.library, *search.current.fit.model.effects)}
