"""Products with the Fisher matrix of a Gaussian policy, written out: what trust-region methods spend their time on.

For a policy N(m(o), diag(s^2)) with the parameters w of m and log s, and the mean over observations o,

    H (v_w, v_s) = (mean J' diag(1/s^2) J v_w,  2 v_s) + damping (v_w, v_s),   J = dm/dw

J v is one pass forwards through the layers, J' u one backwards; every fourth observation of a rollout is enough for the
direction, the length of the step is judged on all of them.
Source: Schulman, Levine, Moritz, Jordan, Abbeel, Trust Region Policy Optimization, ICML 2015, appendix C.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, final

import torch
from sb3_contrib import TRPO

__all__ = ["EVERY", "FisherTRPO", "GaussianFisher"]

Tensor = torch.Tensor

EVERY: Final = 4
"""Of the rollout's observations that the matrix is taken over."""


@final
@dataclass(frozen=True)
class GaussianFisher:
    """H of a mean of dense layers with tanh between them; ``layers`` are (weight, bias), first to last."""

    layers: list[tuple[Tensor, Tensor]]
    log_deviation: Tensor
    inputs: list[Tensor]
    """What goes into each layer, (observations, entries)."""

    @staticmethod
    def at(observations: Tensor, layers: list[tuple[Tensor, Tensor]], log_deviation: Tensor) -> GaussianFisher:
        """The matrix over observations (n, entries)."""
        inputs = [observations]
        for weight, bias in layers[:-1]:
            inputs.append(torch.tanh(torch.addmm(bias, inputs[-1], weight.T)))
        return GaussianFisher(layers, log_deviation, inputs)

    def product(self, log_part: Tensor, parts: list[tuple[Tensor, Tensor]]) -> tuple[Tensor, list[Tensor]]:
        """H of (log s, layers): the part of log s, and the layers' parts, weight and bias in turn."""
        change: Tensor | None = None
        for (weight, _), (to_weight, to_bias), given in zip(self.layers, parts, self.inputs, strict=True):
            moved = torch.addmm(to_bias, given, to_weight.T)
            if change is not None:
                moved += (change * (1.0 - given * given)) @ weight.T
            change = moved
        assert change is not None
        back = change * torch.exp(-2.0 * self.log_deviation) / len(change)
        found: list[Tensor] = []
        for index in reversed(range(len(self.layers))):
            given = self.inputs[index]
            found = [back.T @ given, back.sum(0), *found]
            back = (back @ self.layers[index][0]) * (1.0 - given * given)
        return 2.0 * log_part, found


class FisherTRPO(TRPO):
    """TRPO with these products; its policy is one of dense layers with tanh between them."""

    def train(self) -> None:
        """One update with the rollout that was just collected."""
        self._take_fisher()
        super().train()

    def _take_fisher(self) -> None:
        policy: Any = self.policy
        dense = [*policy.mlp_extractor.policy_net, policy.action_net]
        layers = [
            (layer.weight.detach().clone(), layer.bias.detach().clone())
            for layer in dense
            if isinstance(layer, torch.nn.Linear)
        ]
        seen = torch.as_tensor(self.rollout_buffer.observations).reshape(-1, layers[0][0].shape[1])[::EVERY]
        self._fisher = GaussianFisher.at(seen, layers, policy.log_std.detach().clone())
        self._order = [policy.log_std, *[part for layer in dense for part in layer.parameters()]]

    def hessian_vector_product(
        self, params: list[Any], grad_kl: Tensor, vector: Tensor, retain_graph: bool = True
    ) -> Tensor:
        """H times a vector over ``params``, in their order; the graph of the divergence is not asked."""
        del grad_kl, retain_graph
        pieces = torch.split(vector.detach(), [part.numel() for part in params])
        by_part = {id(part): piece.view(part.shape) for part, piece in zip(params, pieces, strict=True)}
        log_part, *flat = [by_part[id(part)] for part in self._order]
        own, others = self._fisher.product(log_part, list(zip(flat[::2], flat[1::2], strict=True)))
        found = {id(part): piece for part, piece in zip(self._order, [own, *others], strict=True)}
        product: Tensor = torch.cat([found[id(part)].flatten() for part in params])
        return product + self.cg_damping * vector.detach()
