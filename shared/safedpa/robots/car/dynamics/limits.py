"""Performance limits of a car model, and braking by commanding the opposite speed.

``performance_limits`` bounds acceleration, curvature and travel per period of a model. ``ReversalBraking`` is a harder
brake: a speed servo at target 0 brakes less the slower the car is, while with an opposite target it brakes at its limit
almost to standstill. Among moving obstacles these seconds matter.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from math import isfinite
from typing import Final, final

import numpy as np
from numpy.typing import NDArray

from safedpa.dynamics import AbstractDynamics, PhysicsModel
from safedpa.errors import InputError
from safedpa.operations import Operations, Scalar
from safedpa.safety.barriers import planar_body
from safedpa.safety.settings import FilterSettings

_SPEEDS = 9
_MARGIN, _MARGIN_OF_REACH = 1.25, 1.05
"""Safety factors on the bounds, because they are evaluated on a grid of states only."""


@dataclass(frozen=True)
class PerformanceLimits:
    """Bounds of the change of the state in one period p at speed v, with u = |v| + A p.

    |v+ - v| <= A p; |yaw+ - yaw| <= K u p; |x+ - x|, |y+ - y| <= R u p. The defaults exceed the values of the car's
    equations with every load: 6.0 m/s2, and tan(0.34) / 0.32 m = 1.1 / m for the tightest arc.
    """

    acceleration: float = 9.0
    """A [m/s2]."""
    curvature: float = 1.4
    """K [1/m]."""
    reach: float = 1.0
    """R [1]."""


ORDINARY: Final = PerformanceLimits()
"""The smallest bounds that are assumed for any model."""


def performance_limits(model: AbstractDynamics, settings: FilterSettings) -> PerformanceLimits:
    """Computes the limits of a model with state x, y, yaw, speed.

    The maxima are taken over a grid of speeds and the corners of actions, previous actions and latents, increased by a
    quarter, and never below ``ORDINARY``. Infinite when the model returns non-finite values.
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
        return PerformanceLimits(np.inf, np.inf, np.inf)
    acceleration = max(ORDINARY.acceleration, _MARGIN * float(changes[:, 3].max()) / model.period)
    way = (np.abs(speeds) + acceleration * model.period) * model.period
    turned, moved = (float((changes[:, columns].max(axis=1) / way).max()) for columns in ([2], [0, 1]))
    curvature, reach = max(ORDINARY.curvature, _MARGIN * turned), max(ORDINARY.reach, _MARGIN_OF_REACH * moved)
    return PerformanceLimits(acceleration, curvature, reach)


def _latents(model: AbstractDynamics) -> NDArray[np.float64] | None:
    """Returns (corners, 1, latents): the model's own latent and the corners of the latent's range."""
    if not isinstance(model, PhysicsModel) or not model.latent_names:
        return None
    ranges = [model.parameters[name] for name in model.latent_names]
    return np.array([model.latent, *product(*((one.low, one.high) for one in ranges))])[:, None]


IS_STATIONARY: Final = planar_body.IS_STATIONARY
"""m/s; a slower car counts as stationary."""
_LAG: Final = 0.05
"""s; delay until the motor brakes as commanded."""
_SHARE: Final = 3.0
"""The opposite speed command over the current speed; a larger factor would drive the car backwards before it stops."""
_PERIOD: Final = 0.05
"""s; with a longer period the factor is reduced in proportion, for the same reason."""


@final
@dataclass(frozen=True)
class ReversalBraking:
    """Guaranteed braking of a speed servo with target -u: d|v|/dt = -min(k (|v| + u), b), after a lag l.

    ``deceleration`` b [m/s2] and ``gain`` k [1/s] are those of ``Braking``, ``against`` u [m/s] is the largest opposite
    speed command. With s = ``IS_STATIONARY``, c = max(b / k - u, s) and q = min(k (s + u), b) <= that braking,

        T(v) = l min(|v|, s) / s + clip(|v| - s, 0, c - s) / q + max(|v| - c, 0) / b    until |v| <= s
        D(v) = sign(v) (l |v| + min(|v|, c)^2 / (2 q) + (max(|v|, c)^2 - c^2) / (2 b))  until v = 0

    Neither increases under this braking, and D'(v) >= |v| T'(v); docs/reference/robot.md has measurements. Raises
    InputError unless b and k are positive and u is not negative.
    """

    deceleration: float
    gain: float
    against: float

    def __post_init__(self) -> None:
        for name, value, least in (
            ("deceleration", self.deceleration, "above 0"),
            ("gain", self.gain, "above 0"),
            ("against", self.against, "of 0 or more"),
        ):
            if not (isfinite(value) and (value > 0.0 or (value == 0.0 and name == "against"))):
                raise InputError(f"reversal braking, {name}: got {value}, wanted a finite number {least}")

    @property
    def numbers(self) -> tuple[float, float, float]:
        """b [m/s2], q [m/s2], c [m/s]: the arguments of ``seconds`` and ``distance``."""
        corner = max(self.deceleration / self.gain - self.against, IS_STATIONARY)
        return self.deceleration, min(self.gain * (IS_STATIONARY + self.against), self.deceleration), corner

    @staticmethod
    def seconds(speed: Scalar, numbers: tuple[Scalar, Scalar, Scalar], operations: Operations) -> Scalar:
        """Returns T(speed) [s]."""
        hard, soft, corner = numbers
        size = operations.absolute(speed)
        late = operations.minimum(size, IS_STATIONARY) * (_LAG / IS_STATIONARY)
        slow = operations.maximum(operations.minimum(size, corner) - IS_STATIONARY, 0.0) / soft
        return late + slow + operations.maximum(size - corner, 0.0) / hard

    @staticmethod
    def distance(speed: Scalar, numbers: tuple[Scalar, Scalar, Scalar], operations: Operations) -> Scalar:
        """Returns D(speed) [m], with the sign of ``speed``."""
        hard, soft, corner = numbers
        size = operations.absolute(speed)
        slow, fast = operations.minimum(size, corner), operations.maximum(size, corner)
        way = _LAG * size + slow * slow / (2.0 * soft) + (fast * fast - corner * corner) / (2.0 * hard)
        return operations.where(speed > 0.0, way, -way)

    @staticmethod
    def grad_bound(
        speed: Scalar, numbers: tuple[Scalar, Scalar, Scalar], operations: Operations
    ) -> tuple[Scalar, float]:
        """Returns upper bounds of D'(speed) [s] and |T'| [s2/m]."""
        hard, soft, _ = numbers
        most = operations.maximum(1.0 / hard, 1.0 / soft)
        return _LAG + operations.absolute(speed) * most, operations.maximum(_LAG / IS_STATIONARY, most)

    def action(self, state: NDArray[np.float64] | None, period: float) -> NDArray[np.float64]:
        """Returns speed command [m/s] and steer [rad], (2,), at ``state`` (4,); zeros for an unknown state."""
        if state is None or len(state) < 4 or not isfinite(state[3]):
            return np.zeros(2)
        share = _SHARE * min(1.0, _PERIOD / period)
        return np.array([min(max(-share * float(state[3]), -self.against), self.against), 0.0])
