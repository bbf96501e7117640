"""Up to which h an error of h matters: farther from the boundary than that, no margin has to cover it.

With a ceiling H >= epsilon / eta the function c(h) = min(h, H) has the same safe set as h, and whoever keeps the
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
from typing import Final, final

import numpy as np
from numpy.typing import NDArray

from safedpa.safety.settings import FilterSettings

__all__ = ["NO_CEILING", "Ceiling"]

_LAYERS: Final = 10.0
"""The ceiling in units of epsilon / eta of the settings' own margin, which is chosen before any data are seen. The
lowest that is allowed is 1; more leaves room for margins that turn out wider, and for a watch that sees errors before
they matter."""


@final
@dataclass(frozen=True)
class Ceiling:
    """H by kind of barrier."""

    eta: float
    by_kind: dict[str, float] = field(default_factory=dict)
    """In the unit of h; kinds that are not named have none."""

    @classmethod
    def of_settings(cls, settings: FilterSettings) -> Ceiling:
        """Ten times the depth of the layer in which the settings' own margin makes the robot leave."""
        known = {kind: _LAYERS * value / settings.eta for kind, value in settings.epsilon.items() if value > 0.0}
        return cls(settings.eta, known)

    def of(self, kind: str, epsilon: float) -> float:
        """H for a kind of barrier whose margin in force is ``epsilon``: never below epsilon / eta."""
        return max(self.by_kind.get(kind, inf), epsilon / self.eta)

    def errors(self, kind: str, heights: NDArray[np.float64], epsilon: float = 0.0) -> NDArray[np.float64]:
        """The errors (near,) of steps whose least h was predicted and measured as ``heights`` (steps, 2) say.

        Steps in which both are above the ceiling are left out.
        """
        top = self.of(kind, epsilon)
        near = heights[(heights < top).any(axis=1)]
        return np.asarray(np.minimum(near[:, 0], top) - np.minimum(near[:, 1], top))

    def fitting(self, kind: str, margin: Callable[[Ceiling], float]) -> tuple[float, Ceiling]:
        """The margin of a kind, and the lowest of H, 2 H, 4 H, ... that is no less than it over eta.

        ``margin`` is computed from the errors below a ceiling.
        """
        found, ceiling = margin(self), self
        while isfinite(found) and found > self.eta * ceiling.by_kind.get(kind, inf):
            ceiling = Ceiling(self.eta, {**ceiling.by_kind, kind: 2.0 * ceiling.by_kind[kind]})
            found = margin(ceiling)
        return found, ceiling


NO_CEILING: Final = Ceiling(1.0)
"""Every error counts."""
