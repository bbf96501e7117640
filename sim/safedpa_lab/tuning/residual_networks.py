"""Networks that learn the residual of corrected physics from the same few drives without load.

The base is the training simulator, corrected by a diagnosis of the recorded drives (``ground_simulator``), in the
neutral environment. Small networks F + G u of the features and of z = phi(residuals of the last k transitions) learn
its residual, on the recorded drives and on simulated drives with swinging loads and wind. Loss, in units of the untuned
networks' scale:

    one-step error + 2 x error of short predictions in open loop (in one update of five)
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, final

import torch
from torch import nn

from safedpa.dynamics import PhysicsModel
from safedpa.errors import InputError
from safedpa.networks import Weights
from safedpa.networks.weights import STRIDE
from safedpa_lab.tuning.paper import sequence_of
from safedpa_lab.tuning.predictors import (
    AbstractPredictor,
    PredictorDrives,
    ResidualPredictor,
    one_step_errors,
    open_loop_errors,
    scaled_errors,
    spread_latents,
)
from safedpa_sim.training.configuration import Configuration
from safedpa_sim.training.data.drives import random_drives
from safedpa_sim.training.data.recorded_runs import HORIZON, TuningDrive, split
from safedpa_sim.training.environments.batched_simulator import BatchedSimulator
from safedpa_sim.training.networks.modules import (
    AffineNetworks,
    AffineSizes,
    HistoryNetwork,
    affine_networks,
    history_network,
    tensors_of,
)
from safedpa_sim.training.networks.prediction_errors import ALONG
from safedpa_sim.training.progress import ReportProgress, silent

Tensor = torch.Tensor
_CHANGE: Final = 0.005
"""Probability per period that the environment changes in the simulator."""
_ROLLOUT_WEIGHT: Final = 2.0
_SAMPLES: Final = 3000
_SMALLEST: Final = 1e-6
_FREE: Final = 1e6
"""Bound of a latent whose range is not known yet."""
_RETAINED: Final = (
    "feature_middle", "feature_scale", "action_middle", "action_scale", "environment_middle", "environment_scale",
)  # fmt: skip


@final
@dataclass(frozen=True)
class ResidualTuning:
    """Network sizes and training settings. Raises InputError for counts below 1."""

    latents: int = 8
    hidden: int = 128
    cars: int = 600
    """Drives in the corrected simulator."""
    steps: int = 240
    updates: int = 1500
    batch: int = 1024
    recorded: float = 0.25
    """Share of the batch that is recorded data."""
    rollouts: int = 64
    rollout_every: int = 5
    horizon: int = 10
    learning_rate: float = 2e-3
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("latents", "hidden", "cars", "steps", "updates", "batch", "rollouts", "rollout_every", "horizon"):
            if getattr(self, name) < 1:
                raise InputError(f"{name}: got {getattr(self, name)}, wanted at least 1")


def residual_predictor(configuration: Configuration, corrected: PhysicsModel, weights: Weights) -> ResidualPredictor:
    """Builds residual networks from a weights file, on the physics that they were trained with."""
    cars = BatchedSimulator(replace(configuration, simulator=corrected))
    return ResidualPredictor(cars, affine_networks(weights), history_network(weights), weights.description.history)


def residual_weights(predictor: ResidualPredictor, lender: Weights) -> Weights:
    """Returns the weights f, g and phi of residual networks; ``lender`` provides the description."""
    described = replace(lender.description, latents=predictor.networks.sizes.latents, trained_on={"residual": True})
    return Weights({**tensors_of(predictor.networks), **tensors_of(predictor.encoder)}, described)


def untrained_residual(
    configuration: Configuration, corrected: PhysicsModel, weights: Weights, tuning: ResidualTuning | None = None
) -> ResidualPredictor:
    """Builds residual networks whose output is 0, so that they predict physics only; scales are those of
    ``weights``."""
    tuning = ResidualTuning() if tuning is None else tuning
    known, described = affine_networks(weights), weights.description
    sizes = known.sizes
    vectors = {name: getattr(known, name) for name in (*_RETAINED, "increment_scale")}
    free = torch.full((tuning.latents,), _FREE)
    vectors.update(latent_low=-free, latent_high=free, latent_nominal=torch.zeros(tuning.latents))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(tuning.seed)
        own = AffineSizes(sizes.features, sizes.states, sizes.actions, sizes.environment, tuning.latents, tuning.hidden)
        networks = AffineNetworks(described.robot, own, vectors)
        encoder = HistoryNetwork(sizes.features + sizes.states + sizes.actions, described.history, tuning.latents)
    with torch.no_grad():
        for network in (networks.f, networks.g):
            last: Any = network[-1]
            last.weight.zero_()
            last.bias.zero_()
    cars = BatchedSimulator(replace(configuration, simulator=corrected))
    return ResidualPredictor(cars, networks, encoder, described.history)


def learn_residual(
    configuration: Configuration,
    corrected: PhysicsModel,
    weights: Weights,
    drives: Sequence[TuningDrive],
    tuning: ResidualTuning | None = None,
    report_progress: ReportProgress = silent,
) -> ResidualPredictor:
    """Trains residual networks on four fifths of the drives and on simulated ones; returns the best on held-out data.

    ``weights`` provides scales, history and robot. Raises InputError when the drives are too short to hold out a part.
    """
    tuning = ResidualTuning() if tuning is None else tuning
    predictor = untrained_residual(configuration, corrected, weights, tuning)
    generator = torch.Generator().manual_seed(tuning.seed)
    sequence = [sequence_of(predictor.networks, part) for part in split(drives, predictor.history)]
    for count in (tuning.cars, max(1, tuning.cars // 10)):
        sequence.append(
            random_drives(predictor.physics, predictor.networks, count, tuning.steps, _CHANGE, generator, swinging=True)
        )
    scale = predictor.networks.increment_scale.clone()
    recorded, held_out, simulated, judge = _scaled(predictor, sequence)
    training = _ResidualTraining(predictor, scale, tuning, generator)
    training.learn(
        [(recorded, tuning.recorded), (simulated, 1.0 - tuning.recorded)], [held_out, judge], report_progress
    )
    spread_latents(predictor, [recorded, simulated], generator, _SAMPLES)
    return predictor


def judged_error(
    predictor: AbstractPredictor, data: Sequence[PredictorDrives], scale: Tensor, most: int = 256
) -> float:
    """Returns the scaled one-step RMS error plus 1 / ``HORIZON`` of that after ``HORIZON`` steps, mean over parts.

    Each is a mean over the states, from at most ``most`` evenly spread starts.
    """
    total = 0.0
    for part in data:
        one, many = scaled_errors(predictor, part, scale, most)
        total += float(one + many / HORIZON) / len(data)
    return total


@final
@dataclass
class _ResidualTraining:
    predictor: AbstractPredictor
    scale: Tensor
    tuning: ResidualTuning
    generator: torch.Generator

    def learn(
        self,
        parts: Sequence[tuple[PredictorDrives, float]],
        judges: Sequence[PredictorDrives],
        report_progress: ReportProgress,
    ) -> None:
        """Trains by Adam, then restores the state with the least error on the held-out parts."""
        tuning, networks, encoder = self.tuning, self.predictor.networks, self.predictor.encoder
        fitted = [*networks.f.parameters(), *networks.g.parameters(), *encoder.parameters()]
        optimiser = torch.optim.Adam(fitted, tuning.learning_rate)
        best, retained = math.inf, copy.deepcopy((networks.state_dict(), encoder.state_dict()))
        every = max(1, tuning.updates // 10)
        for done in range(tuning.updates):
            for group in optimiser.param_groups:
                group["lr"] = tuning.learning_rate * 0.5 * (1.0 + math.cos(math.pi * done / tuning.updates))
            far = done % tuning.rollout_every == 0
            losses = [share * self._loss(part, share, far=far) for part, share in parts]
            optimiser.zero_grad(set_to_none=True)
            torch.stack(losses).sum().backward()  # type: ignore[no-untyped-call]
            nn.utils.clip_grad_norm_(fitted, 1.0)
            optimiser.step()
            if (done + 1) % every == 0 or done + 1 == tuning.updates:
                judged = judged_error(self.predictor, judges, self.scale)
                report_progress("residual", done + 1, tuning.updates, f"held-out error {judged:.4f}")
                if judged < best:
                    best, retained = judged, copy.deepcopy((networks.state_dict(), encoder.state_dict()))
        networks.load_state_dict(retained[0])
        encoder.load_state_dict(retained[1])

    def _loss(self, part: PredictorDrives, share: float, *, far: bool) -> Tensor:
        tuning = self.tuning
        segments = max(1, round(share * tuning.batch / ALONG))
        start = part.sequence.draw(segments, self.generator, ahead=(ALONG - 1) * STRIDE + 1)
        found, _ = one_step_errors(self.predictor, part, start)
        loss = (found / self.scale).square().mean()
        if far:
            starts = part.sequence.draw(max(1, round(share * tuning.rollouts)), self.generator, ahead=tuning.horizon)
            ahead = open_loop_errors(self.predictor, part, starts, tuning.horizon) / self.scale
            counts = torch.arange(1, tuning.horizon + 1).reshape(-1, 1, 1)
            loss = loss + _ROLLOUT_WEIGHT * (ahead / counts).square().mean()
        return loss


def _scaled(predictor: ResidualPredictor, sequence: Sequence[Any]) -> list[PredictorDrives]:
    """Sets ``increment_scale`` to the residual's standard deviation on the simulated drives; returns all drives."""
    networks = predictor.networks
    seen = predictor.seen(sequence[2])
    left = networks.frame.own_increment(seen.sequence.states, seen.sequence.following) - seen.base
    networks.increment_scale.copy_(left.std(0).clamp_min(_SMALLEST))
    return [predictor.seen(part) for part in sequence]
