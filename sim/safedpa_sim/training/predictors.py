"""Models that are tuned and compared, as one kind of thing: what is known without networks, plus f + g a.

    own-frame increment = base(x, a, memory) + increment_scale (F(n) + G(n) u + C rows[-m:])
    n = [features(x), z],  z = phi(rows)

Networks alone have the base 0; C (none at first) is what tuning online may add, of the last m transitions. Residual
networks have physics as their base, and learn only what it leaves. In open loop phi looks at the rows of what the model
itself has predicted.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, NamedTuple, final

import torch

from safedpa.networks import Weights
from safedpa.networks.weights import STRIDE
from safedpa_sim.training.histories import TransitionSequence, history_rows
from safedpa_sim.training.networks import AffineNetworks, HistoryNetwork, affine_networks, history_network
from safedpa_sim.training.prediction import ALONG, along, latents_along
from safedpa_sim.training.reference_point import ReferencePoint
from safedpa_sim.training.simulator import BatchedCars

__all__ = [
    "AbstractPredictor",
    "NetworkPredictor",
    "PredictorDrives",
    "ResidualPredictor",
    "one_step_errors",
    "open_loop_errors",
    "spread_latents",
]

Tensor = torch.Tensor
_SETTLED = 8
"""Periods after which what the actuators remembered before no longer matters."""
_BEYOND = 0.1
"""Share of the latent's range by which it may go beyond what was seen in tuning."""


class PredictorDrives(NamedTuple):
    """Drives as one predictor sees them."""

    lived: TransitionSequence
    """Its rows are those of the predictor."""
    base: Tensor
    """(n, states): the own-frame increment in SI units that it knows without networks."""


class AbstractPredictor(ABC):
    """One step of a model on torch tensors, and what it sees of a drive."""

    def __init__(self, networks: AffineNetworks, encoder: HistoryNetwork, history: int) -> None:
        self.networks, self.encoder, self.history = networks, encoder, history
        self.recent: Tensor | None = None
        """C (m row, states), in scaled units; None: there is none."""

    @abstractmethod
    def seen(self, lived: TransitionSequence) -> PredictorDrives:
        """The drives with this predictor's own rows and base."""

    @abstractmethod
    def memory(self, lived: TransitionSequence, index: Tensor) -> Any:
        """What the actuators remember before transitions (batch,)."""

    @abstractmethod
    def step(self, state: Tensor, action: Tensor, rows: Tensor, memory: Any) -> tuple[Tensor, Tensor, Any]:
        """States (batch, states) one period later, the row (batch, row) of that transition, and the memory then."""

    def increment(self, state: Tensor, action: Tensor, rows: Tensor) -> Tensor:
        """The own-frame increment (batch, states) in SI units next to the base, for histories (batch, history, row)."""
        scaled: Tensor = self.networks(state, action, self.latent(rows))
        if self.recent is not None:
            newest = rows.flatten(-2)[..., -len(self.recent) :]
            scaled = scaled + newest @ self.recent
        return self.networks.increment_scale * scaled

    def latent(self, rows: Tensor) -> Tensor:
        """z (batch, latents) for histories (batch, history, row), within the range that was seen in tuning."""
        networks = self.networks
        return torch.maximum(torch.minimum(self.encoder(rows), networks.latent_high), networks.latent_low)


@final
class NetworkPredictor(AbstractPredictor):
    """The networks of a weights file; asked about the rear axle where they speak of another ``point``."""

    def __init__(self, weights: Weights, point: ReferencePoint | None = None) -> None:
        super().__init__(affine_networks(weights), history_network(weights), weights.description.history)
        self.point = point
        """Of which the networks speak; None: of the axle itself."""

    def seen(self, lived: TransitionSequence) -> PredictorDrives:  # noqa: D102
        rows = self._row(lived.states, lived.actions, lived.following)
        return PredictorDrives(lived._replace(rows=rows), torch.zeros_like(lived.states))

    def memory(self, lived: TransitionSequence, index: Tensor) -> Any:  # noqa: D102
        del lived, index

    def step(self, state: Tensor, action: Tensor, rows: Tensor, memory: Any) -> tuple[Tensor, Tensor, Any]:  # noqa: D102
        asked = state if self.point is None else self.point.of_axle(state, action)
        own = self.increment(asked, action, rows)
        following = asked + self.networks.frame.world_increment(asked, own)
        following = following if self.point is None else self.point.to_axle(following, action)
        return following, self._row(state, action, following), memory

    def _row(self, state: Tensor, action: Tensor, following: Tensor) -> Tensor:
        if self.point is not None:
            state, following = (self.point.of_axle(part, action) for part in (state, following))
        return history_rows(self.networks, state, action, following)


@final
class ResidualPredictor(AbstractPredictor):
    """Physics in which nothing acts, with its actuators' memory, plus networks for what it leaves.

    A row of the history holds the scaled features, what physics left of the increment over ``increment_scale``, and the
    scaled action: what a load does stands there by itself.
    """

    def __init__(self, physics: BatchedCars, networks: AffineNetworks, encoder: HistoryNetwork, history: int) -> None:
        super().__init__(networks, encoder, history)
        self.physics = physics

    def seen(self, lived: TransitionSequence) -> PredictorDrives:  # noqa: D102
        index = torch.arange(len(lived.states))
        with torch.no_grad():
            after, _ = self._advance(lived.states, lived.actions, self.memory(lived, index))
            base = self.networks.frame.own_increment(lived.states, after)
            left = self.networks.frame.own_increment(lived.states, lived.following) - base
        return PredictorDrives(lived._replace(rows=self._row(lived.states, lived.actions, left)), base)

    def memory(self, lived: TransitionSequence, index: Tensor) -> Any:  # noqa: D102
        first = lived.first[index]
        memory = self.physics.settled(lived.actions[(index - _SETTLED).maximum(first)], self._nothing(len(index)))
        with torch.no_grad():
            for before in range(_SETTLED, 0, -1):
                at = (index - before).maximum(first)
                _, memory = self._advance(lived.states[at], lived.actions[at], memory)
        return memory

    def step(self, state: Tensor, action: Tensor, rows: Tensor, memory: Any) -> tuple[Tensor, Tensor, Any]:  # noqa: D102
        networks = self.networks
        after, memory = self._advance(state, action, memory)
        left = self.increment(state, action, rows)
        own = networks.frame.own_increment(state, after) + left
        return state + networks.frame.world_increment(state, own), self._row(state, action, left), memory

    def _advance(self, state: Tensor, action: Tensor, memory: Any) -> tuple[Tensor, Any]:
        return self.physics.advance(state, action, self._nothing(len(state)), memory)

    def _nothing(self, count: int) -> Tensor:
        return self.physics.nominal.expand(count, -1)

    def _row(self, state: Tensor, action: Tensor, left: Tensor) -> Tensor:
        networks = self.networks
        features = (networks.frame.features(state) - networks.feature_middle) / networks.feature_scale
        return torch.cat((features, left / networks.increment_scale, networks.scaled_action(action)), dim=-1)


def one_step_errors(predictor: AbstractPredictor, seen: PredictorDrives, start: Tensor) -> tuple[Tensor, Tensor]:
    """Own-frame errors (batch, states) in SI units over one step, of ``ALONG`` transitions from each start on, and z.

    Only for predictors of the axle itself; z is not held within its range, so that gradients flow.
    """
    lived, networks, index = seen.lived, predictor.networks, along(start)
    rows = lived.histories(start, predictor.history, (ALONG - 1) * STRIDE)
    latent = latents_along(predictor.encoder, rows, ALONG).flatten(0, 1)
    states = lived.states[index]
    left = networks.frame.own_increment(states, lived.following[index]) - seen.base[index]
    predicted = networks.increment_scale * networks(states, lived.actions[index], latent)
    return predicted - left, latent


def open_loop_errors(predictor: AbstractPredictor, seen: PredictorDrives, index: Tensor, steps: int) -> Tensor:
    """Errors (steps, batch, states) in SI units of predictions from transitions (batch,) on, 1 to ``steps`` ahead.

    An error is the way from the measured to the predicted state, in the frame of the measured one.
    """
    lived = seen.lived
    rows, state, memory = lived.histories(index, predictor.history), lived.states[index], predictor.memory(lived, index)
    found = []
    for step in range(steps):
        state, row, memory = predictor.step(state, lived.actions[index + step], rows, memory)
        rows = torch.cat((rows[:, 1:], row.unsqueeze(1)), dim=1)
        found.append(predictor.networks.frame.own_increment(lived.following[index + step], state))
    return torch.stack(found)


def spread_latents(
    predictor: AbstractPredictor, data: list[PredictorDrives], generator: torch.Generator, count: int
) -> None:
    """Sets the latent's range to what phi says of ``count`` transitions of each part, and a tenth more; 0 lies within.

    Its rest becomes the mean over the first part.
    """
    with torch.no_grad():
        notice = [
            predictor.encoder(part.lived.histories(part.lived.draw(count, generator), predictor.history))
            for part in data
        ]
        low, high = torch.cat(notice).amin(0), torch.cat(notice).amax(0)
        beyond = _BEYOND * (high - low)
        lowest = (low - beyond).clamp_max(0.0)
        predictor.networks.latent_low.copy_(lowest)
        predictor.networks.latent_high.copy_(torch.maximum(high + beyond, -lowest / 3.0))
        predictor.networks.latent_nominal.copy_(notice[0].mean(0))
