"""A common interface for the models that are tuned and compared: a known base plus networks f + g a.

    own-frame increment = base(x, a, memory) + increment_scale (F(n) + G(n) u + C rows[-m:])
    n = [features(x), z],  z = phi(rows)

For plain networks the base is 0; residual networks have physics as the base and learn what it leaves. C, absent at
first, is a linear term in the last m transitions that online tuning may add. In open loop phi sees rows that the model
itself has predicted.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, NamedTuple, final

import torch

from safedpa.networks import Weights
from safedpa.networks.weights import STRIDE
from safedpa_lab.tuning.reference_point import ReferencePoint
from safedpa_sim.training.data.recorded_runs import HORIZON
from safedpa_sim.training.data.transitions import TransitionSequence, history_rows
from safedpa_sim.training.environments.batched_simulator import BatchedSimulator
from safedpa_sim.training.networks.modules import AffineNetworks, HistoryNetwork, affine_networks, history_network
from safedpa_sim.training.networks.prediction_errors import ALONG, along, latents_along

Tensor = torch.Tensor
_SETTLED = 8
"""Periods after which the actuators' earlier memory no longer matters."""
_BEYOND = 0.1
"""Share of the latent's range that is added at each end to the range seen in tuning."""


class PredictorDrives(NamedTuple):
    """Drives with the encoder rows and the base of one predictor."""

    sequence: TransitionSequence
    """Transitions; the rows are those of the predictor."""
    base: Tensor
    """(n, states): own-frame increment of the base in SI units."""


class AbstractPredictor(ABC):
    """A model that predicts one period on torch tensors from state, action, history and actuator memory."""

    def __init__(self, networks: AffineNetworks, encoder: HistoryNetwork, history: int) -> None:
        self.networks, self.encoder, self.history = networks, encoder, history
        self.recent: Tensor | None = None
        """C (m row, states), in scaled units; None if absent."""

    @abstractmethod
    def seen(self, sequence: TransitionSequence) -> PredictorDrives:
        """Computes the predictor's rows and base for drives."""

    @abstractmethod
    def memory(self, sequence: TransitionSequence, index: Tensor) -> Any:
        """Returns the actuators' memory before transitions (batch,)."""

    @abstractmethod
    def step(self, state: Tensor, action: Tensor, rows: Tensor, memory: Any) -> tuple[Tensor, Tensor, Any]:
        """Returns states (batch, states) one period later, the row (batch, row) of that transition, and the memory."""

    def increment(self, state: Tensor, action: Tensor, rows: Tensor) -> Tensor:
        """Returns the networks' own-frame increment (batch, states) in SI units for histories (batch, history, row)."""
        scaled: Tensor = self.networks(state, action, self.latent(rows))
        if self.recent is not None:
            newest = rows.flatten(-2)[..., -len(self.recent) :]
            scaled = scaled + newest @ self.recent
        return self.networks.increment_scale * scaled

    def latent(self, rows: Tensor) -> Tensor:
        """Returns z (batch, latents) for histories (batch, history, row), clipped to the range seen in tuning."""
        networks = self.networks
        return torch.maximum(torch.minimum(self.encoder(rows), networks.latent_high), networks.latent_low)


@final
class NetworkPredictor(AbstractPredictor):
    """The networks of a weights file; states are converted if the networks describe another ``point`` than the axle."""

    def __init__(self, weights: Weights, point: ReferencePoint | None = None) -> None:
        super().__init__(affine_networks(weights), history_network(weights), weights.description.history)
        self.point = point
        """The point whose motion the networks predict; None for the rear axle."""

    def seen(self, sequence: TransitionSequence) -> PredictorDrives:  # noqa: D102
        rows = self._row(sequence.states, sequence.actions, sequence.following)
        return PredictorDrives(sequence._replace(rows=rows), torch.zeros_like(sequence.states))

    def memory(self, sequence: TransitionSequence, index: Tensor) -> Any:  # noqa: D102
        del sequence, index

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
    """Physics in the neutral environment, with actuator memory, plus networks for its residual.

    A history row holds the scaled features, the residual of physics over ``increment_scale``, and the scaled action, so
    that the effect of a load appears there undiluted.
    """

    def __init__(
        self, physics: BatchedSimulator, networks: AffineNetworks, encoder: HistoryNetwork, history: int
    ) -> None:
        super().__init__(networks, encoder, history)
        self.physics = physics

    def seen(self, sequence: TransitionSequence) -> PredictorDrives:  # noqa: D102
        index = torch.arange(len(sequence.states))
        with torch.no_grad():
            after, _ = self._advance(sequence.states, sequence.actions, self.memory(sequence, index))
            base = self.networks.frame.own_increment(sequence.states, after)
            left = self.networks.frame.own_increment(sequence.states, sequence.following) - base
        return PredictorDrives(sequence._replace(rows=self._row(sequence.states, sequence.actions, left)), base)

    def memory(self, sequence: TransitionSequence, index: Tensor) -> Any:  # noqa: D102
        first = sequence.first[index]
        memory = self.physics.settled(sequence.actions[(index - _SETTLED).maximum(first)], self._nothing(len(index)))
        with torch.no_grad():
            for before in range(_SETTLED, 0, -1):
                at = (index - before).maximum(first)
                _, memory = self._advance(sequence.states[at], sequence.actions[at], memory)
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
    """Returns one-step own-frame errors (batch, states) in SI units of ``ALONG`` transitions from each start on, and z.

    Only for predictors of the axle itself. z is not clipped, so that gradients do not vanish.
    """
    sequence, networks, index = seen.sequence, predictor.networks, along(start)
    rows = sequence.histories(start, predictor.history, (ALONG - 1) * STRIDE)
    latent = latents_along(predictor.encoder, rows, ALONG).flatten(0, 1)
    states = sequence.states[index]
    left = networks.frame.own_increment(states, sequence.following[index]) - seen.base[index]
    predicted = networks.increment_scale * networks(states, sequence.actions[index], latent)
    return predicted - left, latent


def open_loop_errors(predictor: AbstractPredictor, seen: PredictorDrives, index: Tensor, steps: int) -> Tensor:
    """Returns open-loop errors (steps, batch, states) in SI units from transitions (batch,) on, 1 to ``steps`` ahead.

    An error is the increment from the measured to the predicted state, in the own frame of the measured one.
    """
    sequence = seen.sequence
    rows, state, memory = (
        sequence.histories(index, predictor.history),
        sequence.states[index],
        predictor.memory(sequence, index),
    )
    found = []
    for step in range(steps):
        state, row, memory = predictor.step(state, sequence.actions[index + step], rows, memory)
        rows = torch.cat((rows[:, 1:], row.unsqueeze(1)), dim=1)
        found.append(predictor.networks.frame.own_increment(sequence.following[index + step], state))
    return torch.stack(found)


def scaled_errors(
    predictor: AbstractPredictor, part: PredictorDrives, scale: Tensor, most: int
) -> tuple[Tensor, Tensor]:
    """Returns the scaled RMS error after one step and after ``HORIZON``, mean over the states.

    From at most ``most`` evenly spread starts.
    """
    sequence = part.sequence
    index = torch.arange(len(sequence.rows))
    starts = index[(sequence.last - index >= HORIZON - 1) & (index - sequence.first >= predictor.history)]
    starts = starts[:: max(1, -(-len(starts) // most))]
    with torch.no_grad():
        found = open_loop_errors(predictor, part, starts, HORIZON) / scale
    size = found.square().mean(1).sqrt().mean(-1)
    return size[0], size[-1]


def spread_latents(
    predictor: AbstractPredictor, data: list[PredictorDrives], generator: torch.Generator, count: int
) -> None:
    """Sets the latent's range to phi's range over ``count`` transitions of each part plus a tenth; it includes 0.

    The nominal latent becomes the mean over the first part.
    """
    with torch.no_grad():
        latents = [
            predictor.encoder(part.sequence.histories(part.sequence.draw(count, generator), predictor.history))
            for part in data
        ]
        low, high = torch.cat(latents).amin(0), torch.cat(latents).amax(0)
        beyond = _BEYOND * (high - low)
        lowest = (low - beyond).clamp_max(0.0)
        predictor.networks.latent_low.copy_(lowest)
        predictor.networks.latent_high.copy_(torch.maximum(high + beyond, -lowest / 3.0))
        predictor.networks.latent_nominal.copy_(latents[0].mean(0))
