"""The states at which a filter is checked, and what its model and barriers say there."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any, Final, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.errors import InputError
from safedpa.safety.barriers.base import AbstractBarrier, AbstractBarrierSet
from safedpa.safety.checks.report import shown
from safedpa.safety.filter import SafetyFilter
from safedpa.safety.validation import checked_output
from safedpa.safety.verdict import Status

__all__ = ["ROUNDING", "SLIGHT", "FilterUnderTest", "Probe", "probed"]


_MOST_STATES, _MOST_DRIVES, _MOST_CORNERS = 60, 12, 16
ROUNDING: Final = 1e-9
"""Share of |h| that is nothing."""
SLIGHT: Final = 0.05
"""Share of epsilon by which a condition may be missed without being told: epsilon is there for more than that."""
_KEPT = (Status.passed, Status.corrected, Status.disabled)


@final
@dataclass(frozen=True)
class FilterUnderTest:
    """A filter with one scene and latent, asked directly: what an action leads to, without a verdict."""

    safe: SafetyFilter
    barriers: AbstractBarrierSet
    margins: Mapping[str, float]
    """By kind of barrier."""
    latent: FloatArray | None

    @cached_property
    def epsilon(self) -> FloatArray:
        """(m,)."""
        return np.array(self.barriers.of_each(self.margins, self.margins.get("default", 0.0)))

    @property
    def threshold(self) -> FloatArray:
        """epsilon / eta (m,): where the condition begins to ask for no more than h itself."""
        return self.epsilon / self.safe.settings.eta

    def slight(self, h: FloatArray) -> FloatArray:
        """(m,) by how much a condition at h (m,) may be missed without being told."""
        return SLIGHT * self.epsilon + ROUNDING * np.abs(h)

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lowest and highest action (actions,)."""
        return self.safe.settings.low, self.safe.settings.high

    def h(self, state: FloatArray) -> FloatArray:
        """h (m,)."""
        return self.barriers.values(state)

    def after(self, state: FloatArray, action: FloatArray) -> FloatArray:
        """The model's next state (states,)."""
        latent = None if self.latent is None else tuple(self.latent.tolist())
        prediction = self.safe.tools.prediction
        return np.array(prediction.following(tuple(state.tolist()), tuple(action.tolist()), latent, None))

    def residual(self, state: FloatArray, action: FloatArray) -> FloatArray:
        """h_i(x+) - (1 - eta) h_i(x) - epsilon_i (m,)."""
        following = self.barriers.since(state.tolist()).values(self.after(state, action))
        return following - (1.0 - self.safe.settings.eta) * self.h(state) - self.epsilon

    def corners(self) -> list[FloatArray]:
        """The extreme actions, or some of them where they are many, and the middle."""
        low, high = self.bounds
        found = [np.array(corner) for corner in product(*zip(low, high, strict=True))]
        if len(found) > _MOST_CORNERS:
            found = [found[at] for at in np.linspace(0, len(found) - 1, _MOST_CORNERS).astype(int)]
        return [*found, 0.5 * (low + high)]

    def backup(self, state: FloatArray) -> FloatArray:
        """The action that the filter falls back to, within its bounds or not. Raises what the user's function does."""
        known: Callable[[FloatArray | None], Any] | None = self.safe.tools.backup
        return self.safe.settings.resting_action if known is None else checked_output("backup", known(state.copy()))


@final
@dataclass(frozen=True)
class Probe:
    """One state and what is known there."""

    state: FloatArray
    h: FloatArray
    """(m,)."""
    residuals: FloatArray
    """(actions tried, m), under the extreme actions and the middle."""
    moved: FloatArray
    """(states,) how far each entry goes within one tick at the most."""
    reached: FloatArray
    """(m,) how far apart the actions tried leave h."""
    inside: bool
    """Whether every h_i >= epsilon_i / eta."""
    kept: bool
    """Whether the filter found an action that satisfies every condition, or misses it slightly; true where not asked."""


def probed(checked: FilterUnderTest, states: Sequence[FloatArray], ticks: int, seed: int) -> list[Probe]:
    """The states given, and states to which the filter lets itself be pushed from there by extreme nominal actions.

    Each nominal action is an extreme action, held for some ticks, in the first drives to their end; a drive ends where the filter
    finds no action that satisfies every condition. Raises whatever barriers and model raise.
    """
    random = np.random.default_rng(seed)
    found = [_probe(checked, state, kept=True) for state in states[:_MOST_STATES]]
    starts = [probe.state for probe in found if probe.inside] or [probe.state for probe in found]
    corners = checked.corners()[:-1]
    for at in range(_MOST_DRIVES):
        pushed = corners[at] if at < min(len(corners), _MOST_DRIVES // 2) else None
        for state, kept in _driven(checked, starts[at % len(starts)], ticks, random, pushed):
            found.append(_probe(checked, state, kept=kept))
    return found


def _driven(
    checked: FilterUnderTest, state: FloatArray, ticks: int, random: np.random.Generator, pushed: FloatArray | None
) -> list[tuple[FloatArray, bool]]:
    """Some states of one drive, and whether the filter satisfied every condition there; the last one always."""
    corners, nominal, held = checked.corners()[:-1], np.zeros(0), 0
    scene: Sequence[AbstractBarrier] = checked.barriers
    visited: list[tuple[FloatArray, bool]] = []
    for tick in range(ticks):
        if pushed is not None:
            nominal = pushed
        elif held == 0:
            nominal, held = corners[int(random.integers(len(corners)))], int(random.integers(3, 25))
        held -= 1
        verdict = checked.safe.decide(state, nominal, checked.latent, barriers=scene, epsilon=checked.margins)
        if tick == 0 and verdict.status is Status.fallback:
            raise InputError(f"the filter decides nothing at {shown(state)}: {verdict.reason}")
        kept = verdict.status in _KEPT
        if tick % 8 == 7 or not kept:
            visited.append((state, kept))
        if not kept:
            break
        state = checked.after(state, verdict.action)
    return visited


def _probe(checked: FilterUnderTest, state: FloatArray, *, kept: bool) -> Probe:
    h = checked.h(state)
    _finite(h, f"at {shown(state)}")
    actions = checked.corners()
    residuals = np.array([checked.residual(state, action) for action in actions])
    moved = np.max([np.abs(checked.after(state, action) - state) for action in actions], axis=0)
    _finite(residuals, f"one tick from {shown(state)}")
    inside = bool((h >= checked.threshold).all())
    missed = -(residuals / np.maximum(checked.slight(h), np.finfo(np.float64).tiny)).min(axis=1)
    return Probe(state, h, residuals, moved, np.ptp(residuals, axis=0), inside, kept or bool(missed.min() < 1.0))


def _finite(numbers: FloatArray, where: str) -> None:
    """Raises InputError for NaN, which no comparison would tell, and for infinity."""
    if not np.isfinite(numbers).all():
        raise InputError(f"got NaN or infinity from h {where}, wanted finite numbers")
