"""Trust-region methods on sb3-contrib: TRPO with products of the Fisher matrix written out, and CPO.

Products with the Fisher matrix of a Gaussian policy, written out: what trust-region methods spend their time on.

For a policy N(m(o), diag(s^2)) with the parameters w of m and log s, and the mean over observations o,

    H (v_w, v_s) = (mean J' diag(1/s^2) J v_w,  2 v_s) + damping (v_w, v_s),   J = dm/dw

J v is one pass forwards through the layers, J' u one backwards; every fourth observation of a rollout is enough for the
direction, the length of the step is judged on all of them.
Source: Schulman, Levine, Moritz, Jordan, Abbeel, Trust Region Policy Optimization, ICML 2015, appendix C.

Constrained policy optimisation on sb3-contrib's trust region.

CPO looks, in each update, for the step x of the policy's parameters

    max g'x   subject to   c + b'x <= 0,   x'Hx / 2 <= delta

with g and b the gradients of the surrogate reward and cost per step, c the mean cost per step less its limit and H the
Fisher information; where no step within the trust region meets the limit it lowers the cost alone. The gradient of the
cost is noisy, so b'H^-1 b is too large and a step promises to take off about ten times the cost that it does: c counts
ten times. (With c as it is the cost stays at half above its limit; the published runs count it a thousand times.)
Source: Achiam, Held, Tamar, Abbeel, Constrained Policy Optimization, ICML 2017.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Final, final

import numpy as np
import torch
from sb3_contrib import TRPO
from sb3_contrib.common.utils import conjugate_gradient_solver
from torch.distributions import kl_divergence
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from safedpa_lab.point.plan import COST_LIMIT
from safedpa_sim.point.task import EPISODE_STEPS

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


_SMALL = 1e-10
_URGENCY: Final = 10.0
"""How many times the excess counts."""


@final
class CostCritic:
    """Expected discounted cost from an observation, learned next to the policy's own critic."""

    def __init__(self, observations: int, hidden: int, discount: float, trace: float, rate: float = 1e-3) -> None:
        layers = [torch.nn.Linear(observations, hidden), torch.nn.Tanh(), torch.nn.Linear(hidden, hidden)]
        self.network = torch.nn.Sequential(*layers, torch.nn.Tanh(), torch.nn.Linear(hidden, 1))
        self._optimiser = torch.optim.Adam(self.network.parameters(), rate)
        self._discount, self._trace = discount, trace

    def advantages(self, observations: Tensor, costs: Tensor, starts: Tensor, last: Tensor) -> tuple[Tensor, Tensor]:
        """Generalised advantages and returns (steps, robots) of observations (steps, robots, n) and their costs.

        ``starts`` (steps, robots): whether an episode began there; ``last`` (robots, n): the observations afterwards.
        An episode ends by time alone, so what follows its last step is valued as that step is.
        """
        with torch.no_grad():
            values = self.network(torch.cat((observations, last.unsqueeze(0)))).squeeze(-1)
        gained = torch.zeros_like(costs)
        running = torch.zeros_like(costs[0])
        begins = torch.cat((starts, torch.zeros_like(starts[:1])))
        for step in reversed(range(len(costs))):
            over = begins[step + 1]
            following = torch.where(over > 0.0, values[step], values[step + 1])
            error = costs[step] + self._discount * following - values[step]
            running = error + self._discount * self._trace * (1.0 - over) * running
            gained[step] = running
        return gained, gained + values[:-1]

    def learn(self, observations: Tensor, returns: Tensor, batch: int, passes: int) -> None:
        """Least squares on observations (n, entries) and returns (n,)."""
        for _ in range(passes):
            for index in torch.split(torch.randperm(len(returns)), batch):
                loss = (self.network(observations[index]).squeeze(-1) - returns[index]).square().mean()
                self._optimiser.zero_grad()
                loss.backward()
                self._optimiser.step()


@dataclass(frozen=True)
class _Step:
    direction: Tensor
    """x, the whole step."""
    for_reward: bool
    """False where the limit is out of reach and the step lowers the cost alone."""


def constrained_step(
    reward_gradient: Tensor, cost_gradient: Tensor, excess: float, largest: float, solve: Callable[[Tensor], Tensor]
) -> _Step:
    """The step x above; ``excess`` is c, ``largest`` delta, ``solve`` gives H^-1 of a vector.

    With q = g'H^-1 g, r = g'H^-1 b, s = b'H^-1 b and the multipliers lambda of the trust region and nu of the cost,
    x = H^-1 (g - nu b) / lambda, nu = max(0, lambda c + r) / s; lambda minimises the dual
    (q - r^2/s) / (2 lambda) + lambda (2 delta - c^2/s) / 2 - r c / s where nu > 0, and q / (2 lambda) + lambda delta
    elsewhere (appendix of the paper).
    """
    by_reward, by_cost = solve(reward_gradient), solve(cost_gradient)
    q, r, s = (
        float(pair) for pair in (reward_gradient @ by_reward, reward_gradient @ by_cost, cost_gradient @ by_cost)
    )
    plain = _Step(float(np.sqrt(2.0 * largest / max(q, _SMALL))) * by_reward, True)
    if s < _SMALL:
        return plain
    room = 2.0 * largest - excess * excess / s
    if room <= 0.0:
        if excess < 0.0:  # the limit lies beyond the trust region
            return plain
        return _Step(-float(np.sqrt(2.0 * largest / s)) * by_cost, False)
    rest = max(q - r * r / s, 0.0)
    minima = []
    if (range_ := _multipliers(excess, r)) is not None:
        trust = _within(np.sqrt(rest / room), range_)
        minima.append((0.5 * rest / trust + 0.5 * trust * room - r * excess / s, trust))
    if (range_ := _multipliers(-excess, -r)) is not None:
        trust = _within(np.sqrt(q / (2.0 * largest)), range_)
        minima.append((0.5 * q / trust + trust * largest, trust))
    _, chosen = min(minima)
    nu = max(0.0, chosen * excess + r) / s
    return _Step((by_reward - nu * by_cost) / chosen, True)


def _multipliers(slope: float, offset: float) -> tuple[float, float] | None:
    """The lambda > 0 with slope lambda + offset >= 0; None where there is none."""
    if abs(slope) <= _SMALL:
        return (0.0, np.inf) if offset >= 0.0 else None
    border = -offset / slope
    if slope > 0.0:
        return max(border, 0.0), np.inf
    return (0.0, border) if border > 0.0 else None


def _within(number: float, bounds: tuple[float, float]) -> float:
    return float(max(min(max(number, bounds[0]), bounds[1]), _SMALL))


@final
class ConstrainedTRPO(FisherTRPO):
    """TRPO whose update heeds the cost; its environment is a ``PointEnvironment``."""

    def __init__(self, *arguments: Any, limit: float = COST_LIMIT, urgency: float = _URGENCY, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self.limit, self.urgency = limit, urgency
        shape = self.observation_space.shape
        assert shape is not None
        self.cost_critic = CostCritic(shape[0], 64, self.gamma, self.gae_lambda)
        self.recent_costs: list[np.ndarray[Any, Any]] = []

    def train(self) -> None:
        """One update of policy and critics with the rollout that was just collected."""
        self._take_fisher()
        costs = torch.as_tensor(np.stack(self.recent_costs), dtype=torch.float32)
        self.recent_costs = []
        buffer = self.rollout_buffer
        observations, starts = torch.as_tensor(buffer.observations), torch.as_tensor(buffer.episode_starts)
        last = torch.as_tensor(self._last_obs)
        advantages, returns = self.cost_critic.advantages(observations, costs, starts, last)
        excess = self._excess(float(costs.mean()))
        self._improve(observations.flatten(0, 1), advantages.flatten(), self.urgency * excess)
        self.cost_critic.learn(observations.flatten(0, 1), returns.flatten(), self.batch_size, self.n_critic_updates)
        self._learn_values()
        self._n_updates += 1

    def _excess(self, mean: float) -> float:
        """c: mean cost per step, of the last whole episodes where there are some, less the limit."""
        environment: Any = self.env
        known = float(np.mean(environment.costs)) / EPISODE_STEPS if environment.costs else mean
        return known - self.limit / EPISODE_STEPS

    def _improve(self, observations: Tensor, cost_advantages: Tensor, excess: float) -> None:
        buffer, policy = self.rollout_buffer, self.policy
        flat = [torch.as_tensor(part).flatten(0, 1) for part in (buffer.actions, buffer.log_probs, buffer.advantages)]
        actions, old_log, advantages = flat
        advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        cost_advantages = cost_advantages - cost_advantages.mean()
        with torch.no_grad():
            old: Any = policy.get_distribution(observations).distribution

        def surrogates() -> tuple[Tensor, Tensor, Tensor]:
            new = policy.get_distribution(observations)
            ratio = torch.exp(new.log_prob(actions) - old_log)
            now: Any = new.distribution
            distance = kl_divergence(now, old).sum(-1).mean()
            return (advantages * ratio).mean(), (cost_advantages * ratio).mean(), distance

        reward, cost, distance = surrogates()
        parameters, reward_gradient, distance_gradient, _ = self._compute_actor_grad(distance, reward)
        found = torch.autograd.grad(cost, parameters, retain_graph=True)
        cost_gradient = torch.cat([part.flatten() for part in found])
        product = partial(self.hessian_vector_product, parameters, distance_gradient)
        step = constrained_step(
            reward_gradient.detach(),
            cost_gradient,
            excess,
            self.target_kl,
            lambda vector: conjugate_gradient_solver(product, vector, max_iter=self.cg_max_steps).detach(),
        )
        self._search_line(parameters, step, surrogates, (reward.item(), cost.item()), excess)

    def _search_line(
        self,
        parameters: list[Any],
        step: _Step,
        surrogates: Callable[[], tuple[Tensor, Tensor, Tensor]],
        before: tuple[float, float],
        excess: float,
    ) -> None:
        """Shortens the step until trust region, cost and reward agree with it; otherwise takes none."""
        origin = parameters_to_vector(parameters).detach().clone()
        share = 1.0
        with torch.no_grad():
            for _ in range(self.line_search_max_iter):
                vector_to_parameters(origin + share * step.direction, parameters)
                reward, cost, distance = (float(part) for part in surrogates())
                better = reward > before[0] or not step.for_reward or excess > 0.0
                if better and cost - before[1] <= max(-excess, 0.0) and distance <= 1.5 * self.target_kl:
                    return
                share *= self.line_search_shrinking_factor
            vector_to_parameters(origin, parameters)

    def _learn_values(self) -> None:
        """The critic of the reward, as TRPO's own; it shares no parameter with the actor."""
        for _ in range(self.n_critic_updates):
            for data in self.rollout_buffer.get(self.batch_size):
                values = self.policy.predict_values(data.observations).flatten()
                loss = (data.returns - values).square().mean()
                self.policy.optimizer.zero_grad()
                loss.backward()  # type: ignore[no-untyped-call]
                self.policy.optimizer.step()
