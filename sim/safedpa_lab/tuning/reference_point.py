"""Conversion of a car's motion, and of networks, between two points on its centre line.

With d the point's distance ahead of the rear axle, L the wheelbase and beta = atan(d / L tan(steer)), a car whose rear
axle rolls along its heading has at once

    axle:  (x, y, yaw, v)        point:  (x + d cos(yaw), y + d sin(yaw), yaw, v / cos(beta))

So networks that were trained on one point can predict the other. Source: Rajamani, Vehicle Dynamics and Control, 2nd
ed., section 2.2. Exact for a rigid car; the speed only while the rear tyres do not slip sideways.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, final

import numpy as np
import torch

from safedpa.errors import InputError
from safedpa.networks import Weights

Tensor = torch.Tensor
_YAW: Final = 2
_SPEED: Final = 3
_STEER: Final = 1
_SIDEWAYS: Final = 1
_STATES: Final = ("x", "y", "yaw", "speed")


@final
@dataclass(frozen=True)
class ReferencePoint:
    """A point on the centre line of a car. Raises InputError for a wheelbase that is not positive."""

    ahead: float
    """d: m ahead of the rear axle."""
    wheelbase: float = float("inf")
    """L in m. Infinite means beta = 0, so that the speed is not converted."""

    def __post_init__(self) -> None:
        if not self.wheelbase > 0.0:
            raise InputError(f"wheelbase: got {self.wheelbase}, wanted more than 0 m")

    def of_axle(self, states: Tensor, actions: Tensor) -> Tensor:
        """Converts states (..., 4) of the rear axle to the point, under actions (..., 2) whose second is the steer."""
        return self._moved(states, self.ahead, 1.0 / self._cosine(actions))

    def to_axle(self, states: Tensor, actions: Tensor) -> Tensor:
        """Converts states (..., 4) of the point to the rear axle; the inverse of ``of_axle``."""
        return self._moved(states, -self.ahead, self._cosine(actions))

    def _cosine(self, actions: Tensor) -> Tensor:
        """cos(beta)."""
        slope = self.ahead / self.wheelbase * torch.tan(actions[..., _STEER])
        return 1.0 / torch.sqrt(1.0 + slope * slope)

    @staticmethod
    def _moved(states: Tensor, ahead: float, factor: Tensor) -> Tensor:
        x, y, yaw, speed = states.unbind(-1)
        moved = (x + ahead * torch.cos(yaw), y + ahead * torch.sin(yaw), yaw, speed * factor)
        return torch.stack(torch.broadcast_tensors(*moved), -1)  # type: ignore[no-untyped-call]


def weights_reported_of_axle(weights: Weights, ahead: float) -> Weights:
    """Converts weights that predict the point ``ahead`` metres in front of the rear axle to weights for the axle.

    Within one period the car turns by a small angle u, and in its own frame the axle moves by

        along_axle = along + d (1 - cos(u)),   across_axle = across - d sin(u) = across - d u + O(d u^3)

    The linear term is merged into the last layers of f and g (across - d u) and into the first layer of phi (across +
    d u). The term d u^2 / 2 along is neglected (0.2 mm at 0.05 rad and 0.15 m), and the speed is not converted. Raises
    InputError for weights of another state than x, y, yaw, speed.
    """
    described = weights.description
    if described.states != _STATES:
        raise InputError(f"weights: got the states {', '.join(described.states)}, wanted {', '.join(_STATES)}")
    scale = weights["increment_scale"].astype(np.float64)
    lever = ahead * scale[_YAW] / scale[_SIDEWAYS]
    changed: dict[str, Any] = {}
    for network, width in (("f", 1), ("g", len(described.actions))):
        last = max(int(name.split(".")[1]) for name in weights.tensors if name.startswith(f"{network}."))
        for part in ("weight", "bias"):
            name = f"{network}.{last}.{part}"
            rows = weights[name].reshape(len(_STATES), width, -1).astype(np.float64)
            rows[_SIDEWAYS] -= lever * rows[_YAW]
            changed[name] = rows.reshape(weights[name].shape)
    if weights.has("phi"):
        seen = weights["phi.dense.0.weight"].astype(np.float64)
        start = len(weights["feature_middle"])
        seen[:, start + _YAW] += lever * seen[:, start + _SIDEWAYS]
        changed["phi.dense.0.weight"] = seen
    return weights.with_tensors(changed)
