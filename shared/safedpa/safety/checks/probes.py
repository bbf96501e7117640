"""The states at which a filter is checked, with what its model and barriers return there."""

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
from safedpa.safety.checks.report import format_vector
from safedpa.safety.filter import SafetyFilter
from safedpa.safety.validation import checked_output
from safedpa.safety.verdict import Status

__all__ = ["ROUNDING", "TOLERANCE", "FilterUnderTest", "Probe", "collect_probes"]


_MAX_STATES, _MAX_DRIVES, _MAX_CORNERS = 60, 12, 16
"""Keep a check within seconds: every drive decides ``ticks`` times, and every probe evaluates all corners."""
ROUNDING: Final = 1e-9
"""Share of |h| that counts as rounding."""
TOLERANCE: Final = 0.05
"""Share of epsilon by which a constraint may be violated without an issue: epsilon covers larger errors than that."""
_FEASIBLE = (Status.passed, Status.corrected, Status.disabled)


@final
@dataclass(frozen=True)
class FilterUnderTest:
    """A filter with one scene and latent, evaluated directly: where an action leads, without a verdict."""

    safe: SafetyFilter
    barriers: AbstractBarrierSet
    margins: Mapping[str, float]
    """Margins by kind of barrier."""
    latent: FloatArray | None

    @cached_property
    def epsilon(self) -> FloatArray:
        """The margin of each row (m,)."""
        return np.array(self.barriers.per_row(self.margins, self.margins.get("default", 0.0)))

    @property
    def threshold(self) -> FloatArray:
        """epsilon / eta (m,): from here on a stationary robot satisfies its constraints."""
        return self.epsilon / self.safe.settings.eta

    def tolerance(self, h: FloatArray) -> FloatArray:
        """(m,) by how much a constraint at h (m,) may be violated without an issue."""
        return TOLERANCE * self.epsilon + ROUNDING * np.abs(h)

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper action bounds (actions,)."""
        return self.safe.settings.low, self.safe.settings.high

    def h(self, state: FloatArray) -> FloatArray:
        """h (m,) at a state (states,)."""
        return self.barriers.h(state)

    def next_state(self, state: FloatArray, action: FloatArray) -> FloatArray:
        """The model's next state (states,)."""
        latent = None if self.latent is None else tuple(self.latent.tolist())
        prediction = self.safe.tools.prediction
        return np.array(prediction.next_state_floats(tuple(state.tolist()), tuple(action.tolist()), latent, None))

    def h_next(self, state: FloatArray, action: FloatArray) -> FloatArray:
        """h (m,) one tick later."""
        return self.barriers.starting_at(state.tolist()).h(self.next_state(state, action))

    def residual(self, state: FloatArray, action: FloatArray) -> FloatArray:
        """h_i(x+) - (1 - eta) h_i(x) - epsilon_i (m,)."""
        return self.h_next(state, action) - (1.0 - self.safe.settings.eta) * self.h(state) - self.epsilon

    def corners(self) -> list[FloatArray]:
        """The extreme actions (a selection if there are many), and the middle of the range."""
        low, high = self.bounds
        found = [np.array(corner) for corner in product(*zip(low, high, strict=True))]
        # Evenly spread over the list of corners: with many actions 2^n of them cannot all be tried.
        if len(found) > _MAX_CORNERS:
            found = [found[at] for at in np.linspace(0, len(found) - 1, _MAX_CORNERS).astype(int)]
        return [*found, 0.5 * (low + high)]

    def backup(self, state: FloatArray) -> FloatArray:
        """The action that the filter falls back to, not clipped. Raises what the user's function raises."""
        known: Callable[[FloatArray | None], Any] | None = self.safe.tools.backup
        return self.safe.settings.resting_action if known is None else checked_output("backup", known(state.copy()))


@final
@dataclass(frozen=True)
class Probe:
    """One state with what is known there."""

    state: FloatArray
    h: FloatArray
    """h (m,) at the state."""
    h_next: FloatArray
    """h (actions, m) one tick later, under the extreme actions and the middle."""
    residuals: FloatArray
    """(actions, m) likewise."""
    moved: FloatArray
    """(states,) the largest change of each entry within one tick."""
    reached: FloatArray
    """(m,) the range of the residuals over these actions."""
    inside: bool
    """Whether every h_i >= epsilon_i / eta."""
    is_feasible: bool
    """Whether the filter found an action that satisfies every constraint up to the tolerance; True if not asked."""


def collect_probes(checked: FilterUnderTest, states: Sequence[FloatArray], ticks: int, seed: int) -> list[Probe]:
    """The given states, and states that the filter lets itself be driven to from there by extreme nominal actions.

    The first drives hold one extreme action to their end, the others change it after some ticks. A drive ends if the
    filter finds no feasible action. Raises whatever barriers and model raise.
    """
    random = np.random.default_rng(seed)
    found = [_probe(checked, state, is_feasible=True) for state in states[:_MAX_STATES]]
    # Drives start inside h >= epsilon / eta, where the filter should never fail; elsewhere a failure says nothing.
    # If no given state is inside, drives from outside are still better than none.
    starts = [probe.state for probe in found if probe.inside] or [probe.state for probe in found]
    corners = checked.corners()[:-1]
    for at in range(_MAX_DRIVES):
        # Half of the drives are deterministic: each corner held to the end finds what random switching may miss.
        constant_nominal = corners[at] if at < min(len(corners), _MAX_DRIVES // 2) else None
        for state, is_feasible in _drive(checked, starts[at % len(starts)], ticks, random, constant_nominal):
            found.append(_probe(checked, state, is_feasible=is_feasible))
    return found


def _drive(
    checked: FilterUnderTest,
    state: FloatArray,
    ticks: int,
    random: np.random.Generator,
    constant_nominal: FloatArray | None,
) -> list[tuple[FloatArray, bool]]:
    """Some states of one drive, and whether the filter found a feasible action there; always with the last one."""
    corners, nominal, held = checked.corners()[:-1], np.zeros(0), 0
    scene: Sequence[AbstractBarrier] = checked.barriers
    visited: list[tuple[FloatArray, bool]] = []
    for tick in range(ticks):
        if constant_nominal is not None:
            nominal = constant_nominal
        elif held == 0:
            # Held for several ticks: an action that alternates in every tick hardly moves the robot.
            nominal, held = corners[int(random.integers(len(corners)))], int(random.integers(3, 25))
        held -= 1
        verdict = checked.safe.decide(state, nominal, checked.latent, barriers=scene, epsilon=checked.margins)
        # A fallback at the first tick means that the inputs themselves are refused: no drive would show anything.
        if tick == 0 and verdict.status is Status.fallback:
            raise InputError(f"the filter decides nothing at {format_vector(state)}: {verdict.reason}")
        # A disabled filter reports no failure, so its drives are not cut short.
        is_feasible = verdict.status in _FEASIBLE
        # Every eighth state: neighbouring ones are nearly the same, and each probe is expensive.
        if tick % 8 == 7 or not is_feasible:
            visited.append((state, is_feasible))
        if not is_feasible:
            break
        state = checked.next_state(state, verdict.action)
    return visited


def _probe(checked: FilterUnderTest, state: FloatArray, *, is_feasible: bool) -> Probe:
    h = checked.h(state)
    _finite(h, f"at {format_vector(state)}")
    actions = checked.corners()
    h_next = np.array([checked.h_next(state, action) for action in actions])
    residuals = h_next - (1.0 - checked.safe.settings.eta) * h - checked.epsilon
    moved = np.max([np.abs(checked.next_state(state, action) - state) for action in actions], axis=0)
    _finite(residuals, f"one tick from {format_vector(state)}")
    inside = bool((h >= checked.threshold).all())
    # The smallest positive float avoids 0 / 0 for a barrier with h = 0 and no margin.
    missed = -(residuals / np.maximum(checked.tolerance(h), np.finfo(np.float64).tiny)).min(axis=1)
    # An extreme action may be feasible even if the filter's search has missed it.
    return Probe(
        state, h, h_next, residuals, moved, np.ptp(residuals, axis=0), inside, is_feasible or bool(missed.min() < 1.0)
    )


def _finite(numbers: FloatArray, where: str) -> None:
    """Raises InputError for NaN, which no comparison would show, and for infinity."""
    if not np.isfinite(numbers).all():
        raise InputError(f"got NaN or infinity from h {where}, wanted finite numbers")
