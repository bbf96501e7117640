"""A learned policy under a model that has more free parameters than its networks' latent."""

from __future__ import annotations

from typing import final

import numpy as np
from numpy.typing import NDArray

from safedpa.bus import StateMessage
from safedpa.dynamics import PhysicsModel
from safedpa.dynamics.settings import LATENT_PREFIX
from safedpa.policy.learned import LearnedPolicy

__all__ = ["NetworkLatent"]


@final
class NetworkLatent:
    """Hands a learned policy the entries of the latent that its networks know.

    Effects that were added to a learned model, by a diagnosis say, may have free parameters of their own.
    """

    def __init__(self, policy: LearnedPolicy, model: PhysicsModel) -> None:
        self._policy = policy
        names = model.latent_names
        self._entries = [index for index, path in enumerate(names) if path.startswith(f"base.{LATENT_PREFIX}")]

    def wish(self, state: StateMessage, latent: NDArray[np.float64] | None) -> tuple[tuple[float, ...], str]:
        """As the policy, with the model's latent (latents,)."""
        return self._policy.wish(state, None if latent is None else latent[self._entries])
