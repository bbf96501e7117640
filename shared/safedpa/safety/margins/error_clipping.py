"""Error clipping: up to which h a prediction error matters. Further from the boundary no margin has to cover it.

With a clip level H >= epsilon / eta the function c(h) = min(h, H) has the same safe set as h, and an action that
satisfies the constraint of h satisfies that of c(h):

    h(x+) >= (1 - eta) h(x) + epsilon   implies   c(h(x+)) >= (1 - eta) c(h(x)) + epsilon,

since c is increasing, the right-hand side of h(x) > H is larger than that of H, and that of h(x) <= H is H at most: (1
- eta) H + epsilon <= H. So every statement about invariance holds with the errors of c(h) in place of those of h. The
distance of an obstacle that is metres away may be wrong by half a metre without any consequence.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from math import inf, isfinite
from typing import Final, NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from safedpa.safety.settings import FilterSettings

__all__ = ["NO_CLIP", "ErrorClip", "HSample"]

_LAYERS: Final = 10.0
"""Clip level in units of epsilon / eta of the settings' margin, which is chosen before any data are seen. The smallest
valid value is 1; more leaves room for wider margins, and shows the online margin errors before they matter."""


_UNCLIPPED: Final = 1e12
"""Above every clip level: a sample without a previous one."""


class HSample(NamedTuple):
    """The smallest h of a kind of barrier in one step, predicted and measured.

    Beyond a dead time the constraint is h(x+) >= (1 - eta) h(x) + epsilon with x predicted itself. The error of h at x
    then counts as well, times (1 - eta) and with the opposite sign.
    """

    predicted: float
    measured: float
    predicted_prev: float = _UNCLIPPED
    measured_prev: float = _UNCLIPPED


@final
@dataclass(frozen=True)
class ErrorClip:
    """The clip level H by kind of barrier."""

    eta: float
    by_kind: dict[str, float] = field(default_factory=dict)
    """In the unit of h; other kinds are not clipped."""

    @classmethod
    def of_settings(cls, settings: FilterSettings) -> ErrorClip:
        """Ten times the depth epsilon / eta of the boundary layer of the settings' margin."""
        # From the settings, not from data: a level chosen by the errors themselves would void the coverage.
        known = {kind: _LAYERS * value / settings.eta for kind, value in settings.epsilon.items() if value > 0.0}
        return cls(settings.eta, known)

    def level(self, kind: str, epsilon: float) -> float:
        """H for a kind of barrier with margin ``epsilon``: never below epsilon / eta."""
        # A margin widened online may exceed the configured clip level; the proof needs H >= epsilon / eta.
        return max(self.by_kind.get(kind, inf), epsilon / self.eta)

    def error(self, kind: str, sample: HSample, epsilon: float) -> float | None:
        """The error of one step; None if all of it is above the clip level."""
        clip_level = self.level(kind, epsilon)
        # Such a step says nothing about the boundary; an error of 0 instead would make the margin look too good.
        if all(h >= clip_level for h in sample):
            return None
        predicted, measured, predicted_prev, measured_prev = (h if h < clip_level else clip_level for h in sample)
        return predicted - measured - (1.0 - self.eta) * (predicted_prev - measured_prev)

    def errors(self, kind: str, samples: NDArray[np.float64], epsilon: float = 0.0) -> NDArray[np.float64]:
        """``error`` of many steps, rows of ``samples`` (steps, 4); those that count (near,)."""
        margin_found = (self.error(kind, HSample(*row), epsilon) for row in samples.tolist())
        return np.array([error for error in margin_found if error is not None], dtype=np.float64)

    def fit_margin(self, kind: str, margin: Callable[[ErrorClip], float]) -> tuple[float, ErrorClip]:
        """Returns the margin of a kind, and the smallest of H, 2 H, 4 H, ... that is at least this margin over eta.

        ``margin`` is computed from the errors below a clip level.
        """
        margin_found, clip = margin(self), self
        # A margin beyond eta H would violate H >= epsilon / eta: doubling ends, since errors are bounded.
        while isfinite(margin_found) and margin_found > self.eta * clip.by_kind.get(kind, inf):
            clip = clip.doubled(kind)
            margin_found = margin(clip)
        return margin_found, clip

    def doubled(self, kind: str) -> ErrorClip:
        """A clip level twice as high for one kind of barrier."""
        return ErrorClip(self.eta, {**self.by_kind, kind: 2.0 * self.by_kind.get(kind, inf)})


NO_CLIP: Final = ErrorClip(1.0)
"""No clipping: every error counts."""
