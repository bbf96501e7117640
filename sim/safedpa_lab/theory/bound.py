"""The corrected bound of SafeDPA's Theorem 1: by how much h may fall short of its prediction in one step.

In scaled coordinates (increments v of the state in the robot's own frame over their scales, actions u over half their
range) the true step and the filter's prediction of it are

    v = F*(x, e) + G*(x, e) u + r,      v^ = F(x, z^) + G(x, z^) u,      z = mu(e),  z^ = phi(history).

Increments in the sup norm, actions and latents in the 1-norm, matrices in the norm induced by these two (the largest
entry), and the gradient p of h in the dual of the sup norm, the 1-norm (Hoelder):

    |h(x + v) - h(x + v^)| <= |p|_1 ( eps_f + eps_g |u|_1 + eps_r + (L_F + L_G |u|_1) eps_z )

with |p|_1 the largest on the way from one state to the other. The page of the docs on theory proves it line by line.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from math import isfinite
from typing import Any, final

import numpy as np
from numpy.typing import ArrayLike

from safedpa.arrays import FloatArray
from safedpa.errors import InputError
from safedpa.networks import Frame


@final
@dataclass(frozen=True)
class ErrorConstants:
    """The constants of the bound, scaled, >= 0. Raises InputError naming the one that is not."""

    f: float
    """eps_f >= |F*(x, e) - F(x, mu(e))|_sup."""
    g: float
    """eps_g >= the largest entry of |G*(x, e) - G(x, mu(e))|."""
    remainder: float
    """eps_r >= |r|_sup: what of the true step is not affine in the action."""
    latent: float
    """eps_z >= |phi(history) - mu(e)|_1."""
    lipschitz_f: float
    """L_F >= |F(x, z) - F(x, z')|_sup / |z - z'|_1: of the networks alone, since z enters nothing else."""
    lipschitz_g: float
    """L_G, likewise for the entries of G."""

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if not (isfinite(value) and value >= 0.0):
                raise InputError(f"{item.name}: got {value}, wanted a finite number >= 0; measure on more transitions")

    def of_step(self, effort: Any) -> Any:
        """Largest error |v - v^|_sup of a step under actions whose 1-norm |u|_1 is ``effort``, any shape."""
        return self.f + self.g * effort + self.remainder + (self.lipschitz_f + self.lipschitz_g * effort) * self.latent


def barrier_error_bound(gradient: ArrayLike, constants: ErrorConstants, action: ArrayLike) -> FloatArray:
    """|p|_1 times the error of the step: shape of the leading axes.

    ``gradient`` (..., states) of h by v, and ``action`` (..., actions) u, both scaled.
    """
    p, u = np.asarray(gradient, dtype=np.float64), np.asarray(action, dtype=np.float64)
    return np.asarray(np.abs(p).sum(axis=-1) * constants.of_step(np.abs(u).sum(axis=-1)))


def scaled_gradient(gradient: FloatArray, state: FloatArray, frame: Frame, scale: FloatArray) -> FloatArray:
    """d(h)/d(v) (..., states) from d(h)/d(x) (..., states): v are increments in the frame of ``state`` (states,).

    A scaled increment v moves the state by R(x) diag(scale) v, so the gradient by v is diag(scale) R(x)' d(h)/d(x).
    """
    turned = frame.world_increment(state, np.eye(len(scale)))  # row i: what a unit increment of entry i does
    return np.asarray(gradient @ turned.T * scale)
