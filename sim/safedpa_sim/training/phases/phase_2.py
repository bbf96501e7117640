"""Phase 2: the history encoder phi, trained on its own drives to estimate z = mu(e).

In each round, thousands of simulated cars drive with the policy and phi's own latent, so that phi is trained on the
histories that it causes. Environments change while driving. All rounds, or the newest ones, form the training set.
Loss, with the standard deviation ``spread`` of mu(e):

    mean over latents of ((phi(history) - mu(e)) / spread)^2

Some of z cannot be observed in a history, for example how a load of mass 0 would slide, or a force across the heading.
This part of the loss remains. The summary reports it for each latent, together with its effect on the predictions.
Source: Kumar et al., RMA: Rapid Motor Adaptation, RSS 2021, section III.B; Ross et al., DAgger, AISTATS 2011.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, final

import torch

from safedpa.networks import Weights
from safedpa.networks.weights import STRIDE
from safedpa_sim.training.configuration import Configuration
from safedpa_sim.training.data.drives import policy_drives, random_drives
from safedpa_sim.training.data.transitions import TransitionSequence, concatenate
from safedpa_sim.training.environments.batched_simulator import BatchedSimulator
from safedpa_sim.training.environments.policy_task import TASKS, BatchedEnvironment, task_of
from safedpa_sim.training.networks.modules import HistoryNetwork, affine_networks, tensors_of
from safedpa_sim.training.networks.prediction_errors import ALONG, along, explained, latents_along
from safedpa_sim.training.optimisation import cosine_rate, descend, training_device
from safedpa_sim.training.progress import ReportProgress, silent

Tensor = torch.Tensor
_STREAM = 6
"""Random stream of this phase: its seed is seed * 10 + this number."""
_SAMPLES = 8000
_HELD_OUT_CARS = 500
_REPORTED = 20
"""Updates between two progress reports."""


def train_history_encoder(
    configuration: Configuration,
    weights: Weights,
    out: Path,
    report_progress: ReportProgress = silent,
    device: str = "cpu",
) -> tuple[Weights, dict[str, Any]]:
    """Trains phi for the mu, f, g and policy of ``weights``; without a policy the cars drive at random.

    Returns the weights with phi, and a summary: for each latent the share of mu's variance that phi explains on
    held-out drives, and the prediction errors with mu's latent and with phi's.
    """
    del out
    training = _HistoryTraining(configuration, weights, training_device(device))
    for index in range(configuration.phase_2.rounds):
        training.add_drives()
        training.learn(index, report_progress)
    described = replace(weights.description, history=configuration.history)
    return weights.with_tensors(tensors_of(training.encoder), described), training.summary()


@final
class _HistoryTraining:
    def __init__(self, configuration: Configuration, weights: Weights, device: torch.device) -> None:
        self.configuration, self.weights = configuration, weights
        phase, seed = configuration.phase_2, configuration.seed * 10 + _STREAM
        self.cars = cars = BatchedSimulator(configuration, device)
        self.generator = cars.generator(seed)
        self.networks = affine_networks(weights).requires_grad_(False).to(device)
        sizes = self.networks.sizes
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            row = sizes.features + sizes.states + sizes.actions
            self.encoder = HistoryNetwork(row, configuration.history, sizes.latents).to(device)
        self.optimiser = torch.optim.Adam(self.encoder.parameters(), phase.learning_rate)
        drawn = cars.draw_environments(_SAMPLES, self.generator)
        self.spread = self.networks.encode(drawn).std(0).clamp_min(1e-3)
        """Standard deviation of each entry of z = mu(e), (latents,)."""
        self.driving: BatchedEnvironment | None = None
        """Robots that the policy drives; None without a policy."""
        if weights.has("policy"):
            count = max(1, round(phase.driven * phase.cars))
            self.driving = task_of(configuration.robot).make_environment(configuration, weights, count, seed)
        self.known: list[TransitionSequence] = []
        """Training data, one item per round."""
        self.pairs = 0
        """Transitions of all rounds."""
        self.losses: list[float] = []

    def add_drives(self) -> None:
        """Simulates the drives of the next round with the current phi."""
        phase = self.configuration.phase_2
        self.known = [*self.known, self._sequence(phase.cars)][-phase.retained :]
        self.pairs += len(self.known[-1].rows)

    def _sequence(self, count: int) -> TransitionSequence:
        """Simulates drives: a share of the cars by the policy with phi's latent, if there is one, the others at
        random."""
        phase = self.configuration.phase_2
        driving, parts = self.driving, []
        if driving is not None:
            history = self.configuration.history
            parts.append(policy_drives(driving, self.weights, self.networks, self.encoder, phase.steps, history))
            count -= driving.count
        if count > 0:
            robot, change, generator = self.configuration.robot, phase.change, self.generator
            drives = task_of(robot).random_drives if robot in TASKS else random_drives
            parts.append(drives(self.cars, self.networks, count, phase.steps, change, generator))
        return concatenate(parts)

    def learn(self, round_: int, report_progress: ReportProgress) -> None:
        """Runs the updates of one round on histories of all rounds so far."""
        phase = self.configuration.phase_2
        everything = phase.rounds * phase.updates
        for index in range(phase.updates):
            done = round_ * phase.updates + index
            rate = cosine_rate(phase.learning_rate, phase.last_learning_rate, done, everything)
            loss = self._step(phase.batch, rate)
            if done % _REPORTED == 0:
                self.losses.append(loss)
                report_progress("2", done, everything, f"loss {loss:.3f}")

    def _step(self, batch: int, rate: float) -> float:
        """Runs one Adam step on histories drawn from all rounds and returns its loss."""
        which = torch.randint(len(self.known), (1,), generator=self.generator, device=self.cars.device)
        sequence = self.known[int(which)]
        start = sequence.draw(max(1, round(batch / ALONG)), self.generator, ahead=(ALONG - 1) * STRIDE + 1)
        index = along(start)
        rows = sequence.histories(start, self.configuration.history, (ALONG - 1) * STRIDE)
        rows = _disturbed(rows, self.configuration.phase_2.noise, self.generator)
        latents = latents_along(self.encoder, rows, ALONG).flatten(0, 1)
        loss = ((latents - sequence.latents[index]) / self.spread).square().mean()
        return float(descend(self.optimiser, loss, rate))

    def summary(self) -> dict[str, Any]:
        """Evaluates phi on new drives; only full histories count."""
        history = self.configuration.history
        sequence = self._sequence(min(self.configuration.phase_2.cars, _HELD_OUT_CARS))
        with torch.no_grad():
            index = sequence.draw(_SAMPLES, self.generator, before=history)
            latent, seen = sequence.latents[index], self.encoder(sequence.histories(index, history))
            return {
                "loss": float(((seen - latent) / self.spread).square().mean()),
                "explained": explained(seen, latent).tolist(),
                "one_step_error_with_mu": self._errors(sequence, index, latent),
                "one_step_error_with_phi": self._errors(sequence, index, seen),
                "driven_by": "random" if self.driving is None else "policy and random",
                "pairs": self.pairs,
                "learning_curve": self.losses,
            }

    def _errors(self, sequence: TransitionSequence, index: Tensor, latent: Tensor) -> list[float]:
        """Returns the root mean square of the scaled one-step error for each state."""
        states, following, actions = sequence.states[index], sequence.following[index], sequence.actions[index]
        increment = self.networks.frame.own_increment(states, following) / self.networks.increment_scale
        errors = self.networks(states, actions, latent) - increment
        result: list[float] = errors.square().mean(0).sqrt().tolist()
        return result


def _disturbed(rows: Tensor, noise: float, generator: torch.Generator) -> Tensor:
    """Adds measurement noise to the rows. Rows of zeros, from before the first transition, stay zero."""
    drawn = torch.randn(rows.shape, generator=generator, device=rows.device)
    return rows + noise * drawn * rows.abs().amax(-1, keepdim=True).gt(0.0)
