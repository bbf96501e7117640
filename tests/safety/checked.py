"""A filter to be checked, and states as the check knows them, on a point that moves by a tenth of its action a tick."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from safedpa.safety import AbstractBarrier, FilterSettings, FunctionBarrier, SafetyFilter
from safedpa.safety.barriers.stack import make_barrier_set
from safedpa.safety.checks.probes import FilterUnderTest, Probe

Values = NDArray[np.float64]


def slide(x: Values) -> tuple[Values, Values]:
    return x, 0.1 * np.eye(len(x))


def made(
    *barriers: AbstractBarrier | Callable[[Values], Any], model: Callable[..., Any] = slide, epsilon: Any = 0.002,
    eta: float = 0.1, actions: int = 1, backup: Any = None, latent: Values | None = None,
    limits: tuple[float, float] = (-1.0, 2.0),
) -> FilterUnderTest:  # fmt: skip
    """A filter of some barriers, asked directly; no backup: the settings' action, 0."""
    parts = [
        one if isinstance(one, AbstractBarrier) else FunctionBarrier(one, names=(f"h{at}",))
        for at, one in enumerate(barriers)
    ]
    settings = FilterSettings(
        action_low=(limits[0],) * actions, action_high=(limits[1],) * actions, backup_action=(0.0,) * actions, eta=eta,
        epsilon=epsilon if isinstance(epsilon, dict) else {"default": epsilon},
    )  # fmt: skip
    safe = SafetyFilter(model, parts, settings, backup=backup)
    return FilterUnderTest(safe, make_barrier_set(parts), settings.epsilon, latent)


def probe(
    *state: float, h: Any = 1.0, residuals: Any = 0.0, moved: Any = 0.1, reached: Any = 0.3, inside: bool = True,
    kept: bool = True,
) -> Probe:  # fmt: skip
    def flat(numbers: Any, axes: int) -> Values:
        return np.array(numbers, dtype=np.float64, ndmin=axes)

    return Probe(
        np.array(state), flat(h, 1), flat(h, 2), flat(residuals, 2), flat(moved, 1), flat(reached, 1), inside, kept
    )


def first(x: Values) -> float:
    return float(x[0])
