"""Phase 2: the history encoder phi, taught on its own drives to tell what mu tells.

In rounds, thousands of cars drive in the simulator with phi's own latent in the policy, so that phi meets the histories
that it causes itself; all rounds are kept, or the newest ones. Environments change while driving. Loss, with the spread
of z = mu(e):

    mean over latents of ((phi(history) - mu(e)) / spread)^2

What no history shows cannot be learned: how a load of mass 0 would slide, a force across the heading. That part of the
loss stays; the summary tells it for each latent, and what it costs in predictions.
Source: Kumar et al., RMA: Rapid Motor Adaptation, RSS 2021, section III.B; Ross et al., DAgger, AISTATS 2011.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, final

import torch

from safedpa.networks import Weights
from safedpa.networks.weights import STRIDE
from safedpa_sim.training.configuration import Configuration
from safedpa_sim.training.drives import policy_drives, random_drives
from safedpa_sim.training.explained_motion import explained
from safedpa_sim.training.histories import TransitionSequence, joined
from safedpa_sim.training.networks import AffineNetworks, HistoryNetwork, affine_networks, tensors_of
from safedpa_sim.training.phase_1a import training_device
from safedpa_sim.training.practice import Practice, has_task, task_of
from safedpa_sim.training.prediction import ALONG, along, latents_along
from safedpa_sim.training.progress import ReportProgress, silent
from safedpa_sim.training.simulator import BatchedCars

__all__ = ["train_history_encoder"]

Tensor = torch.Tensor
_STREAM = 6
"""Seeds of this phase: seed * 10 + this."""
_SAMPLES = 8000
_HELD_OUT_CARS = 500
_REPORTED = 20
"""Updates between two words about the progress."""


def train_history_encoder(
    configuration: Configuration,
    weights: Weights,
    out: Path,
    report_progress: ReportProgress = silent,
    device: str = "cpu",
) -> tuple[Weights, dict[str, Any]]:
    """phi for the mu, f, g and policy of ``weights``; without a policy the cars drive at random.

    Returns the weights with phi, and what is worth recording: for each latent the share of mu's variance that phi
    explains on drives that it was not trained on, and the prediction errors with mu's latent and with phi's.
    """
    del out
    training = _HistoryTraining.begin(configuration, weights, training_device(device))
    for index in range(configuration.phase_2.rounds):
        training.add_drives()
        training.learn(index, report_progress)
    described = replace(weights.description, history=configuration.history)
    return weights.with_tensors(tensors_of(training.encoder), described), training.summary()


@final
@dataclass
class _HistoryTraining:
    configuration: Configuration
    weights: Weights
    cars: BatchedCars
    driving: Practice | None
    """Robots at the policy's task; nothing without a policy."""
    networks: AffineNetworks
    encoder: HistoryNetwork
    optimiser: torch.optim.Adam
    generator: torch.Generator
    spread: Tensor
    """Standard deviation of each entry of z = mu(e), (latents,)."""
    known: list[TransitionSequence] = field(default_factory=list)
    """One item per round."""
    pairs: int = 0
    """Of all rounds."""
    losses: list[float] = field(default_factory=list)

    @staticmethod
    def begin(configuration: Configuration, weights: Weights, device: torch.device) -> _HistoryTraining:
        cars = BatchedCars(configuration, device)
        generator = cars.generator(configuration.seed * 10 + _STREAM)
        networks = affine_networks(weights).requires_grad_(False).to(device)
        sizes = networks.sizes
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(configuration.seed * 10 + _STREAM)
            row = sizes.features + sizes.states + sizes.actions
            encoder = HistoryNetwork(row, configuration.history, sizes.latents).to(device)
        optimiser = torch.optim.Adam(encoder.parameters(), configuration.phase_2.learning_rate)
        spread = networks.encode(cars.draw_environments(_SAMPLES, generator)).std(0).clamp_min(1e-3)
        driving = None
        if weights.has("policy"):
            seed = configuration.seed * 10 + _STREAM
            count = max(1, round(configuration.phase_2.driven * configuration.phase_2.cars))
            driving = task_of(configuration.robot).practice(configuration, weights, count, seed, 0.0, True)
        return _HistoryTraining(configuration, weights, cars, driving, networks, encoder, optimiser, generator, spread)

    def add_drives(self) -> None:
        """One more round, driven with phi as it is now."""
        phase = self.configuration.phase_2
        self.known = [*self.known, self._lived(phase.cars)][-phase.retained :]
        self.pairs += len(self.known[-1].rows)

    def _lived(self, count: int) -> TransitionSequence:
        """Some cars drive to goals by the policy with phi's latent, if there is one; the others at random."""
        phase = self.configuration.phase_2
        driving, parts = self.driving, []
        if driving is not None:
            history = self.configuration.history
            parts.append(policy_drives(driving, self.weights, self.networks, self.encoder, phase.steps, history))
            count -= driving.count
        if count > 0:
            robot, change, generator = self.configuration.robot, phase.change, self.generator
            drives = task_of(robot).random_drives if has_task(robot) else random_drives
            parts.append(drives(self.cars, self.networks, count, phase.steps, change, generator))
        return joined(parts)

    def learn(self, round_: int, report_progress: ReportProgress) -> None:
        """The updates of one round, on histories of all rounds so far."""
        phase = self.configuration.phase_2
        everything = phase.rounds * phase.updates
        for index in range(phase.updates):
            done = round_ * phase.updates + index
            share = 0.5 * (1.0 + math.cos(math.pi * done / everything))
            rate = phase.last_learning_rate + (phase.learning_rate - phase.last_learning_rate) * share
            for group in self.optimiser.param_groups:
                group["lr"] = rate
            loss = self._step(phase.batch)
            if done % _REPORTED == 0:
                self.losses.append(loss)
                report_progress("2", done, everything, f"loss {loss:.3f}")

    def _step(self, batch: int) -> float:
        """One step of Adam on histories drawn from all rounds; its loss."""
        which = torch.randint(len(self.known), (1,), generator=self.generator, device=self.cars.device)
        lived = self.known[int(which)]
        start = lived.draw(max(1, round(batch / ALONG)), self.generator, ahead=(ALONG - 1) * STRIDE + 1)
        index = along(start)
        rows = lived.histories(start, self.configuration.history, (ALONG - 1) * STRIDE)
        rows = _disturbed(rows, self.configuration.phase_2.noise, self.generator)
        latents = latents_along(self.encoder, rows, ALONG).flatten(0, 1)
        loss = ((latents - lived.latents[index]) / self.spread).square().mean()
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        self.optimiser.step()
        return float(loss.detach())

    def summary(self) -> dict[str, Any]:
        """What was reached on fresh drives; only full histories count."""
        history = self.configuration.history
        lived = self._lived(min(self.configuration.phase_2.cars, _HELD_OUT_CARS))
        with torch.no_grad():
            index = lived.draw(_SAMPLES, self.generator, before=history)
            latent, seen = lived.latents[index], self.encoder(lived.histories(index, history))
            return {
                "loss": float(((seen - latent) / self.spread).square().mean()),
                "explained": explained(seen, latent).tolist(),
                "one_step_error_with_mu": self._errors(lived, index, latent),
                "one_step_error_with_phi": self._errors(lived, index, seen),
                "driven_by": "random" if self.driving is None else "policy and random",
                "pairs": self.pairs,
                "learning_curve": self.losses,
            }

    def _errors(self, lived: TransitionSequence, index: Tensor, latent: Tensor) -> list[float]:
        """Root mean square of the scaled one-step error, for each state."""
        states, following, actions = lived.states[index], lived.following[index], lived.actions[index]
        increment = self.networks.frame.own_increment(states, following) / self.networks.increment_scale
        errors = self.networks(states, actions, latent) - increment
        result: list[float] = errors.square().mean(0).sqrt().tolist()
        return result


def _disturbed(rows: Tensor, noise: float, generator: torch.Generator) -> Tensor:
    """Rows with measurement noise; rows of zeros, before the first transition, stay zeros."""
    drawn = torch.randn(rows.shape, generator=generator, device=rows.device)
    return rows + noise * drawn * rows.abs().amax(-1, keepdim=True).gt(0.0)
