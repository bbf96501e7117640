"""Manoeuvres of a system of one's own, in the words of its actions: steps, holds and sweeps of each by itself."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from safedpa.compare.windows import Floats
from safedpa.systems import System, Variable

__all__ = ["general_manoeuvres"]

_SMALL, _LARGE = 0.2, 0.5
"""Of an action's range, from where it rests."""


def general_manoeuvres(system: System, t: Floats) -> dict[str, tuple[Floats, Floats]]:
    """Start (states,) and actions (rows, actions) of each manoeuvre, by what one would say; the others rest.

    An action rests at 0, or at its nearer bound where 0 is none of its values. A state begins in the middle of its
    bounds, at 0 where that lies within them.
    """
    start = np.array([_rest(variable) for variable in system.state])
    found = {}
    for index, action in enumerate(system.action):
        for text, column in _of(action, t):
            actions = np.tile([_rest(other) for other in system.action], (len(t), 1))
            actions[:, index] = column
            found[text] = (start.copy(), actions)
    return found


def _of(action: Variable, t: Floats) -> Iterator[tuple[str, Floats]]:
    rest, unit = _rest(action), "" if action.unit == "1" else f" {action.unit}"
    reach = action.high - rest if np.isfinite(action.high) else 1.0
    small, large = rest + _SMALL * reach, rest + _LARGE * reach
    name = action.name.replace("_", " ")
    yield f"{name} in steps between {rest:.3g} and {large:.3g}{unit}", np.where(np.sin(4.0 * t) > 0.0, large, rest)
    yield f"hold {name} at {small:.3g}, then at {large:.3g}{unit}", np.where(t < 0.5 * t[-1], small, large)
    yield (
        f"{name} at {large:.3g}{unit} for 2 s, then let it go to {rest:.3g} and wait",
        np.where(t < 2.0, large, rest),
    )
    if action.low < rest:
        low = rest - _LARGE * (rest - action.low if np.isfinite(action.low) else 1.0)
        yield f"sweep {name} slowly between {low:.3g} and {large:.3g}{unit}", rest + (large - rest) * np.sin(t)


def _rest(variable: Variable) -> float:
    if variable.low <= 0.0 <= variable.high:
        return 0.0
    return float(variable.low if variable.low > 0.0 else variable.high)
