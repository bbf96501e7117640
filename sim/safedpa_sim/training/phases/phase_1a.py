"""Phase 1a: the environment encoder mu and the control-affine networks f and g, trained jointly."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from time import monotonic
from typing import Any, final

import torch

from safedpa.errors import InputError, did_you_mean
from safedpa.networks import Weights, frame_of
from safedpa_sim.training.configuration import Configuration
from safedpa_sim.training.data.transitions import Transitions, draw_transitions, scales
from safedpa_sim.training.environments.batched_simulator import BatchedSimulator
from safedpa_sim.training.export.weights import export_weights, normalise_latent
from safedpa_sim.training.networks.modules import AffineNetworks, AffineSizes, unit_latent
from safedpa_sim.training.networks.prediction_errors import affine_floor, evaluate
from safedpa_sim.training.optimisation import Checkpoint, cosine_rate, descend, training_device
from safedpa_sim.training.progress import ReportProgress, silent

_HELD_OUT = 20_000
_STREAMS = {"scales": 1, "training": 2, "held_out": 3, "latents": 4, "floor": 5}
"""Random stream of each purpose: its seed is seed * 10 + this number."""
_REPORT_PROGRESS_SECONDS = 0.5
_POINTS = 200
"""Points of the learning curve."""


def train_affine(
    configuration: Configuration,
    out: Path,
    report_progress: ReportProgress = silent,
    device: str = "cpu",
    variant: str = "1a",
    alone: Mapping[str, float] | None = None,
) -> tuple[Weights, dict[str, Any]]:
    """Trains mu, f and g on simulated transitions, each used once.

    Minimises mean(((increment - predicted) / increment_scale)^2) by Adam. In variant ``1a`` f and g take z = mu(e). In
    all other variants they have no latent: they are trained in all environments (Mix), or, given ``alone``, in one
    (Fix): values by path, all other parameters neutral.

    Returns the weights and a summary: loss, explained variance and error of each state on held-out transitions, and the
    share of the variance that no model affine in the action can explain. Checkpoints are written to ``out``. An
    interrupted training resumes from there, with a bit-identical result on the same kind of processor and with the same
    number of threads.
    """
    training = _AffineTraining(configuration, variant, training_device(device), alone)
    digest = f"{variant} {configuration.digest('phase_1a', 'ablations')}"
    checkpoint = Checkpoint(out / f"checkpoint_{variant}.pt", digest)
    training.run(checkpoint.read(training.restore) or 0, checkpoint, report_progress)
    normalise_latent(training.networks, training.cars, training.seed("latents"))
    summary = training.summary() | {"learning_curve": training.curve}
    weights = export_weights(
        training.networks,
        training.cars,
        configuration,
        {"phase": variant, "pairs": summary["pairs"], "seed": configuration.seed, "loss": summary["loss"]},
    )
    checkpoint.path.unlink(missing_ok=True)
    return weights, summary


@final
class _AffineTraining:
    def __init__(
        self, configuration: Configuration, variant: str, device: torch.device, alone: Mapping[str, float] | None
    ) -> None:
        self.configuration, self.variant = configuration, variant
        self.cars = cars = BatchedSimulator(configuration, device)
        phase, ablations = configuration.phase_1a, configuration.ablations
        whole = variant == "1a"
        hidden = phase.hidden if whole else ablations.hidden
        self.networks = _networks(cars, configuration, hidden, whole).to(device)
        self.optimiser = torch.optim.Adam(self.networks.parameters(), phase.learning_rate, fused=True)
        self.generator = cars.generator(self.seed("training"))
        self.pairs = phase.pairs if whole else ablations.pairs
        self.alone = None if alone is None else _environment(cars, alone)
        """The only environment (entries,) of Fix."""
        self.curve: list[list[float]] = []
        self.losses: list[torch.Tensor] = []
        """Losses since the last point of the curve. They stay tensors: reading each value would wait for the device."""

    @property
    def steps(self) -> int:
        return math.ceil(self.pairs / self.configuration.phase_1a.batch)

    def seed(self, purpose: str) -> int:
        return self.configuration.seed * 10 + _STREAMS[purpose]

    def restore(self, content: Mapping[str, Any]) -> int:
        """Restores an interrupted training from its checkpoint and returns the steps that it has done."""
        self.networks.load_state_dict(content["module"])
        self.optimiser.load_state_dict(content["optimiser"])
        self.generator.set_state(content["generator"])
        self.curve = content["reported"]["curve"]
        self.losses = [loss.to(self.cars.device) for loss in content["reported"]["losses"]]
        return int(content["done"])

    def run(self, done: int, checkpoint: Checkpoint, report_progress: ReportProgress) -> None:
        """Trains until all steps are done and appends [pairs, mean loss] to ``curve``.

        Checkpoints are written only between steps: an interrupt within a step leaves weights and optimiser
        inconsistent.
        """
        saved = reported = monotonic()
        while done < self.steps:
            self._note(done, self._step(done))
            done += 1
            now = monotonic()
            if self.curve and now - reported > _REPORT_PROGRESS_SECONDS:
                self._report(done, report_progress)
                reported = now
            if now - saved > self.configuration.phase_1a.checkpoint_seconds:
                checkpoint.write(
                    done=done,
                    module=self.networks.state_dict(),
                    optimiser=self.optimiser.state_dict(),
                    generator=self.generator.get_state(),
                    reported={"curve": self.curve, "losses": self.losses},
                )
                saved = now
        self._report(done, report_progress)

    def _note(self, done: int, loss: torch.Tensor) -> None:
        self.losses.append(loss)
        if (done + 1) % max(1, self.steps // _POINTS) == 0 or done + 1 == self.steps:
            mean = float(torch.stack(self.losses).mean())
            self.curve.append([(done + 1) * self.configuration.phase_1a.batch, mean])
            self.losses = []

    def _report(self, done: int, report_progress: ReportProgress) -> None:
        batch = self.configuration.phase_1a.batch
        report_progress(self.variant, done * batch, self.steps * batch, f"loss {self.curve[-1][1]:.2e}")

    def _step(self, done: int) -> torch.Tensor:
        """Runs one Adam step on new transitions and returns its loss."""
        phase = self.configuration.phase_1a
        rate = cosine_rate(phase.learning_rate, phase.last_learning_rate, done, self.steps)
        environment, state, action, increment = self._transitions(phase.batch, self.generator)
        networks = self.networks
        predicted = networks(state, action, networks.encode(environment))
        loss = (predicted - increment / networks.increment_scale).square().mean()
        return descend(self.optimiser, loss, rate)

    def _transitions(self, count: int, generator: torch.Generator) -> Transitions:
        return draw_transitions(self.cars, count, generator, environment=self.alone)

    def summary(self) -> dict[str, Any]:
        """Evaluates the networks on held-out transitions from the training environments."""
        held_out = self._transitions(_HELD_OUT, self.cars.generator(self.seed("held_out")))
        floor = affine_floor(self.cars, self.cars.generator(self.seed("floor")))
        return {
            "pairs": self.steps * self.configuration.phase_1a.batch,
            "states": list(self.cars.model.system.state_names),
            **evaluate(self.networks, held_out),
            "not_affine": floor.tolist(),
        }


def _environment(cars: BatchedSimulator, alone: Mapping[str, float]) -> torch.Tensor:
    """Returns the environment (entries,) with these values by path; InputError for a path that is not randomised."""
    paths = [entry.path for entry in cars.entries]
    for path in alone:
        if path not in paths:
            raise InputError(f"environment '{path}': {did_you_mean(path, paths)}")
    values = [alone.get(path, float(usual)) for path, usual in zip(paths, cars.nominal, strict=True)]
    return torch.tensor(values, dtype=torch.float32, device=cars.device)


def _networks(cars: BatchedSimulator, configuration: Configuration, hidden: int, whole: bool) -> AffineNetworks:
    """Returns the initial networks. They depend on the seed only, not on the device."""
    system = cars.model.system
    sizes = AffineSizes(
        features=len(frame_of(system.name).feature_names),
        states=len(system.state),
        actions=len(system.action),
        environment=len(cars.entries),
        latents=configuration.latents if whole else 0,
        hidden=hidden,
        encoder_hidden=configuration.phase_1a.encoder_hidden,
    )
    vectors = scales(cars, configuration.seed * 10 + _STREAMS["scales"])
    if whole:
        vectors |= unit_latent(configuration.latents)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(configuration.seed)
        return AffineNetworks(system.name, sizes, vectors)
