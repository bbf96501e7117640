"""The same motion, told of another point of the car.

With d the point's distance ahead of the rear axle, L the wheelbase and beta = atan(d / L tan(steer)), a car whose rear
axle rolls along its heading has at once

    axle:  (x, y, yaw, v)        point:  (x + d cos(yaw), y + d sin(yaw), yaw, v / cos(beta))

Networks that were trained on the one can so be asked about the other. Source: Rajamani, Vehicle Dynamics and Control,
2nd ed., section 2.2; exact for a rigid car, its speed while the rear tyres do not slip sideways.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, final

import numpy as np
import torch

from safedpa.errors import InputError
from safedpa.networks import Weights

__all__ = ["ReferencePoint", "weights_reported_of_axle"]

Tensor = torch.Tensor
_YAW: Final = 2
_SPEED: Final = 3
_STEER: Final = 1
_SIDEWAYS: Final = 1
_STATES: Final = ("x", "y", "yaw", "speed")


@final
@dataclass(frozen=True)
class ReferencePoint:
    """A point on the middle line of a car. Raises InputError for a wheelbase that is none."""

    ahead: float
    """m ahead of the rear axle: d."""
    wheelbase: float = float("inf")
    """m: L. Without one the speed is told as it is: beta = 0."""

    def __post_init__(self) -> None:
        if not self.wheelbase > 0.0:
            raise InputError(f"wheelbase: got {self.wheelbase}, wanted more than 0 m")

    def of_axle(self, states: Tensor, actions: Tensor) -> Tensor:
        """States (..., 4) of the point for those of the rear axle, under actions (..., 2) whose second is the steer."""
        return self._moved(states, self.ahead, 1.0 / self._cosine(actions))

    def to_axle(self, states: Tensor, actions: Tensor) -> Tensor:
        """The inverse of ``of_axle``: states (..., 4) of the rear axle for those of the point."""
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
    """Weights that say of the rear axle what these say of the point ``ahead`` metres in front of it.

    Within one period the car turns by a small angle u, and in its own frame the axle moves by

        along_axle = along + d (1 - cos(u)),   across_axle = across - d sin(u) = across - d u + O(d u^3)

    What is linear is taken into f's and g's last and phi's first layer: across loses d u where the networks tell it,
    and gains it where phi looks at it. Left out: d u^2 / 2 along (0.2 mm at 0.05 rad and 0.15 m). The speed is told as
    it is. Raises InputError for weights of another state than x, y, yaw, speed.
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
