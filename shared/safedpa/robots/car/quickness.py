"""How quick a model of a car is: its largest acceleration, its tightest arc, and how far it goes for its speed."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Final

import numpy as np
from numpy.typing import NDArray

from safedpa.dynamics import AbstractDynamics, PhysicsModel
from safedpa.safety.settings import FilterSettings

__all__ = ["ORDINARY", "Quickness", "quickness_of"]

_SPEEDS = 9
_MARGIN, _MARGIN_OF_REACH = 1.25, 1.05
"""Between the states that are looked at there are others."""


@dataclass(frozen=True)
class Quickness:
    """Bounds of what one period does, of a car of speed v and with u = |v| + A p.

    |v+ - v| <= A p; |yaw+ - yaw| <= K u p; |x+ - x|, |y+ - y| <= R u p. The least that is assumed lies above
    the car's equations with every load: 6.0 m/s2, and of its arcs the tightest, tan(0.34) / 0.32 m, is 1.1.
    """

    acceleration: float = 9.0
    """A [m/s2]."""
    curvature: float = 1.4
    """K [1/m]."""
    reach: float = 1.0
    """R [1]."""


ORDINARY: Final = Quickness()
"""The least that is assumed."""


def quickness_of(model: AbstractDynamics, settings: FilterSettings) -> Quickness:
    """Of a model of x, y, yaw, speed: over speeds, the corners of its actions, of those before, and of its latents.

    The bounds that are found are widened by a quarter, and never less than the least that is assumed. Infinite where
    the model gives what is no number.
    """
    speeds = np.linspace(settings.barrier("speed_low"), settings.barrier("speed_high"), _SPEEDS)
    state = np.zeros((_SPEEDS, 1, 1, 1, 4))
    state[..., 3] = speeds[:, None, None, None]
    corners = np.array(list(product(*zip(settings.action_low, settings.action_high, strict=True))))
    actions = np.concatenate([corners, settings.resting_action[None]])
    latent = _latents(model)
    memory = model.initial_memory(actions[:, None, None], latent)
    after = model.advance(state, actions, memory, latent)[0]
    changes = np.abs(after - state).max(axis=(1, 2, 3))
    if not np.isfinite(changes).all():
        return Quickness(np.inf, np.inf, np.inf)
    acceleration = max(ORDINARY.acceleration, _MARGIN * float(changes[:, 3].max()) / model.period)
    way = (np.abs(speeds) + acceleration * model.period) * model.period
    turned, moved = (float((changes[:, columns].max(axis=1) / way).max()) for columns in ([2], [0, 1]))
    curvature, reach = max(ORDINARY.curvature, _MARGIN * turned), max(ORDINARY.reach, _MARGIN_OF_REACH * moved)
    return Quickness(acceleration, curvature, reach)


def _latents(model: AbstractDynamics) -> NDArray[np.float64] | None:
    """(corners, 1, latents): what it has by itself, and the corners of what an adaptation may find."""
    if not isinstance(model, PhysicsModel) or not model.latent_names:
        return None
    ranges = [model.parameters[name] for name in model.latent_names]
    return np.array([model.latent, *product(*((one.low, one.high) for one in ranges))])[:, None]
