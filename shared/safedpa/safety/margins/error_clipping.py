"""Up to which h an error of h matters: farther from the boundary than that, no margin has to cover it.

With a ceiling H >= epsilon / eta the function c(h) = min(h, H) has the same safe set as h, and anyone who keeps the
condition of h keeps that of c(h):

    h(x+) >= (1 - eta) h(x) + epsilon   implies   c(h(x+)) >= (1 - eta) c(h(x)) + epsilon,

since c is increasing, the right-hand side of h(x) > H is larger than that of H, and that of h(x) <= H is H at most:
(1 - eta) H + epsilon <= H. So every statement about invariance holds with the errors of c(h) in place of those of h. A
hazard that is metres away may be misjudged by half a metre without any consequence.
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
"""The ceiling in units of epsilon / eta of the settings' own margin, which is chosen before any data are seen. The
lowest that is allowed is 1; more leaves room for margins that turn out wider, and for a watch that sees errors before
they matter."""


_FAR: Final = 1e12
"""Above every ceiling but none."""


class HSample(NamedTuple):
    """The least h of a kind of barrier, predicted and measured, of one step.

    Past a dead time the condition is h(x+) >= (1 - eta) h(x) + epsilon with x predicted itself. Then the error of h at
    x counts as well: (1 - eta) times, and with the other sign.
    """

    hoped: float
    measured: float
    hoped_before: float = _FAR
    before: float = _FAR


@final
@dataclass(frozen=True)
class ErrorClip:
    """H by kind of barrier."""

    eta: float
    by_kind: dict[str, float] = field(default_factory=dict)
    """In the unit of h; kinds that are not named have none."""

    @classmethod
    def of_settings(cls, settings: FilterSettings) -> ErrorClip:
        """Ten times the depth of the layer in which the settings' own margin makes the robot leave."""
        known = {kind: _LAYERS * value / settings.eta for kind, value in settings.epsilon.items() if value > 0.0}
        return cls(settings.eta, known)

    def of(self, kind: str, epsilon: float) -> float:
        """H for a kind of barrier whose margin in force is ``epsilon``: never below epsilon / eta."""
        return max(self.by_kind.get(kind, inf), epsilon / self.eta)

    def error(self, kind: str, seen: HSample, epsilon: float) -> float | None:
        """The error of one step; None where everything is above the ceiling."""
        top = self.of(kind, epsilon)
        if all(h >= top for h in seen):
            return None
        hoped, measured, hoped_before, before = (h if h < top else top for h in seen)
        return hoped - measured - (1.0 - self.eta) * (hoped_before - before)

    def errors(self, kind: str, heights: NDArray[np.float64], epsilon: float = 0.0) -> NDArray[np.float64]:
        """``error`` of many steps, rows of ``heights`` (steps, 4); those that count (near,)."""
        found = (self.error(kind, HSample(*row), epsilon) for row in heights.tolist())
        return np.array([error for error in found if error is not None], dtype=np.float64)

    def fitting(self, kind: str, margin: Callable[[ErrorClip], float]) -> tuple[float, ErrorClip]:
        """The margin of a kind, and the lowest of H, 2 H, 4 H, ... that is no less than it over eta.

        ``margin`` is computed from the errors below a ceiling.
        """
        found, clip = margin(self), self
        while isfinite(found) and found > self.eta * clip.by_kind.get(kind, inf):
            clip = clip.doubled(kind)
            found = margin(clip)
        return found, clip

    def doubled(self, kind: str) -> ErrorClip:
        """Twice as high for one kind of barrier."""
        return ErrorClip(self.eta, {**self.by_kind, kind: 2.0 * self.by_kind.get(kind, inf)})


NO_CLIP: Final = ErrorClip(1.0)
"""Every error counts."""
