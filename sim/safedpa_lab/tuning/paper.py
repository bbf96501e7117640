"""Tuning with the loss of the paper only: the one-step error on the real data.

    L_TUNE = mean over the recorded transitions of |x[t+1] - f(x[t], phi(h[t])) - g(x[t], phi(h[t])) a[t]|^2

f, g and phi are tuned together, h the last k transitions. Source: Xiao et al., Safe Deep Policy Adaptation, ICRA 2024,
the fine-tuning phase. Assumed, because the paper does not specify it: states in SI units without weights, so that a
radian counts as much as a metre; Adam with a cosine schedule; the final state is used. There is no held-out data, no
simulated drive is mixed in, and no term keeps z close to mu(e).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, final

import torch

from safedpa.errors import InputError
from safedpa.networks import Weights
from safedpa.networks.weights import STRIDE
from safedpa_lab.tuning.predictors import NetworkPredictor, one_step_errors, spread_latents
from safedpa_sim.training.data.recorded_runs import TuningDrive
from safedpa_sim.training.data.transitions import TransitionSequence, concatenate, transition_sequence
from safedpa_sim.training.networks.modules import AffineNetworks, tensors_of
from safedpa_sim.training.networks.prediction_errors import ALONG
from safedpa_sim.training.progress import ReportProgress, silent

_SAMPLES: Final = 5000


@final
@dataclass(frozen=True)
class PaperTuning:
    """Settings that the paper does not specify. Raises InputError for values that are too small."""

    updates: int = 1500
    batch: int = 1024
    learning_rate: float = 1e-3
    seed: int = 0

    def __post_init__(self) -> None:
        if self.updates < 1 or self.batch < ALONG:
            raise InputError(
                f"tuning: got {self.updates} updates of {self.batch}, wanted 1 and {ALONG} at least; raise them"
            )


def tune_as_written(
    weights: Weights,
    drives: Sequence[TuningDrive],
    tuning: PaperTuning | None = None,
    report_progress: ReportProgress = silent,
) -> Weights:
    """Tunes f, g and phi by L_TUNE on all drives. Raises InputError for weights without phi."""
    if not weights.has("phi"):
        raise InputError("weights: no history encoder (phi) in them, wanted one to tune; run phase 2 first")
    tuning = PaperTuning() if tuning is None else tuning
    predictor = NetworkPredictor(weights)
    generator = torch.Generator().manual_seed(tuning.seed)
    seen = predictor.seen(sequence_of(predictor.networks, drives))
    fitted = [*predictor.networks.f.parameters(), *predictor.networks.g.parameters(), *predictor.encoder.parameters()]
    optimiser = torch.optim.Adam(fitted, tuning.learning_rate)
    segments, ahead = tuning.batch // ALONG, (ALONG - 1) * STRIDE + 1
    for done in range(tuning.updates):
        for group in optimiser.param_groups:
            group["lr"] = tuning.learning_rate * 0.5 * (1.0 + math.cos(math.pi * done / tuning.updates))
        found, _ = one_step_errors(predictor, seen, seen.sequence.draw(segments, generator, ahead=ahead))
        loss = found.square().sum(-1).mean()
        optimiser.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        if done % 100 == 0:
            report_progress("L_TUNE", done, tuning.updates, f"loss {float(loss.detach()):.2e}")
    spread_latents(predictor, [seen], generator, _SAMPLES)
    tensors = {**tensors_of(predictor.networks), **tensors_of(predictor.encoder)}
    reported = {**weights.description.trained_on, "tuned": {"loss": "L_TUNE as written", "updates": tuning.updates}}
    return weights.with_tensors(tensors, replace(weights.description, trained_on=reported))


def sequence_of(networks: AffineNetworks, drives: Sequence[TuningDrive]) -> TransitionSequence:
    """Converts recorded drives of any lengths to a sequence of transitions."""
    parts = []
    for states, actions in drives:
        tensors = [torch.as_tensor(part, dtype=torch.float32).unsqueeze(0) for part in (states, actions)]
        parts.append(transition_sequence(networks, *tensors))
    return concatenate(parts)
