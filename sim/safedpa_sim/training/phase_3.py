"""Phase 3: f, g and phi tuned on few data of the real robot.

First on the recorded data alone. Then the tuned robot drives in imagination under the loads and winds of the
configuration (see ``imagined``), and everything is tuned on both, so that what phase 2 learned of loads is kept and
fitted to this robot. Loss, with z = phi(history), so that z also tells where motor and steering stand:

    one-step error + error of short rollouts in which phi looks at the predictions + anchor |phi - mu(e)|^2

A part of the recorded runs is never fitted to. The best state by its error there is kept, and nothing is returned that
does not predict it better than the untuned networks. Source: Xiao et al., Safe Deep Policy Adaptation, ICRA 2024, phase
3; imagination, rollouts and anchor are ours.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, final

import numpy as np
import torch
from torch import nn

from safedpa.errors import InputError
from safedpa.networks import Weights
from safedpa_sim.training.circles import record_circles
from safedpa_sim.training.configuration import Configuration
from safedpa_sim.training.histories import Lived, joined, lived
from safedpa_sim.training.imagined import imagined_drives
from safedpa_sim.training.networks import (
    AffineNetworks,
    HistoryNetwork,
    affine_networks,
    history_network,
    tensors_of,
)
from safedpa_sim.training.phase_1a import training_device
from safedpa_sim.training.prediction import errors, one_step_loss, rollout_loss
from safedpa_sim.training.progress import Tell, silent
from safedpa_sim.training.simulator import BatchedCars
from safedpa_sim.training.tuning_data import HORIZON, Drive, drives_of, load_tuning_runs, split

__all__ = ["WHAT", "tune", "tune_on_drives", "tune_on_runs"]

Tensor = torch.Tensor
What = Literal["all", "phi", "heads"]
WHAT: Final = ("all", "phi", "heads")
"""f, g and phi; phi alone; the last layer of each of the three."""
_STREAM = 7
"""Seeds of this phase: seed * 10 + this."""
_CHANGE = 0.005
"""Probability per period that the environment changes in imagination."""
_JUDGED = 10
"""How often within each part the held-out error is taken."""
_STARTS = 600
"""Rollouts that it is taken over."""
_JUDGING = 10
"""One imagined drive to judge by for so many to learn from."""
_BEYOND = 0.1
"""Share of the latent's range by which it may go beyond what was seen in tuning."""
_WARM_UP = 0.05
"""Share of the updates in which the learning rate rises."""


def tune(
    configuration: Configuration, weights: Weights, out: Path, tell: Tell = silent, device: str = "cpu"
) -> tuple[Weights, dict[str, Any]]:
    """Records circles without load from the pymunk car and tunes everything on them; see ``tune_on_drives``."""
    del out
    phase = configuration.phase_3
    runs = record_circles(phase.pairs, configuration.seed * 10 + _STREAM, phase.run_pairs)
    drives = drives_of(runs, weights)
    tuned, summary = tune_on_drives(configuration, weights, drives, "all", tell, device)
    return tuned, {"runs": "circles without load", **summary}


def tune_on_runs(
    configuration: Configuration,
    weights: Weights,
    runs: Sequence[Path],
    columns: Path | None,
    out: Path,
    tell: Tell = silent,
    what: str = "all",
) -> tuple[Weights, dict[str, Any]]:
    """Tunes on recorded files; see ``load_tuning_runs`` for what is refused, and ``tune_on_drives``."""
    del out
    if what not in WHAT:
        raise InputError(f"--what: got '{what}', wanted one of {', '.join(WHAT)}")
    drives = load_tuning_runs(runs, columns, configuration.simulator.system, weights)
    tuned, summary = tune_on_drives(configuration, weights, drives, what, tell)  # type: ignore[arg-type]
    return tuned, {"runs": ", ".join(path.name for path in runs), **summary}


def tune_on_drives(
    configuration: Configuration,
    weights: Weights,
    drives: Sequence[Drive],
    what: What = "all",
    tell: Tell = silent,
    device: str = "cpu",
) -> tuple[Weights, dict[str, Any]]:
    """The weights tuned on drives, and the held-out errors before and after.

    Raises InputError when the weights hold no history encoder, when there is too little to hold out, or when the tuned
    networks predict the held-out part no better than the untuned ones.
    """
    if not weights.has("phi"):
        raise InputError("weights: no history encoder (phi) in them, wanted one to tune; run phase 2 first")
    training = _Tuning.begin(configuration, weights, drives, what, training_device(device))
    phase = configuration.phase_3
    before = training.held_out_errors()
    training.learn([training.recorded], phase.updates, "3", tell)
    if phase.imagined_updates and weights.has("mu"):
        imagined = training.imagine(phase.cars)
        training.judges.append(training.imagine(max(1, phase.cars // _JUDGING)))
        training.learn([training.recorded, imagined], phase.imagined_updates, "3 imagined", tell)
        training.spread([training.recorded, imagined])
    else:
        training.spread([training.recorded])
    after = training.held_out_errors()
    summary = {
        "what": what,
        "pairs": len(training.recorded.rows),
        "held_out_pairs": len(training.held_out.rows),
        "untuned": before,
        "tuned": after,
        "times_better": {name: before[name]["mean"] / after[name]["mean"] for name in before},
    }
    worse = [name for name in before if not after[name]["mean"] < before[name]["mean"]]
    if worse:
        listed = ", ".join(f"{n}: {before[n]['mean']:.3g} before, {after[n]['mean']:.3g} after" for n in worse)
        raise InputError(
            f"tuning: the held-out error did not fall ({listed}), so nothing was written; record more, and more varied "
            "runs, or tune less (--what heads, --what phi)"
        )
    return training.weights(summary), summary


@final
@dataclass
class _Tuning:
    configuration: Configuration
    untuned: Weights
    networks: AffineNetworks
    encoder: HistoryNetwork
    recorded: Lived
    held_out: Lived
    fitted: list[nn.Parameter]
    generator: torch.Generator
    cars: BatchedCars
    judges: list[Lived]
    """What nothing is fitted to: the held-out part of the recorded data, then of the imagined too."""

    @staticmethod
    def begin(
        configuration: Configuration, weights: Weights, drives: Sequence[Drive], what: What, device: torch.device
    ) -> _Tuning:
        networks, encoder = affine_networks(weights).to(device), history_network(weights).to(device)
        networks.requires_grad_(False)
        encoder.requires_grad_(False)
        fitted = _fitted(networks, encoder, what)
        for parameter in fitted:
            parameter.requires_grad_(True)
        parts = split(drives, weights.description.history)
        recorded, held_out = (joined([_lived(networks, drive, device) for drive in part]) for part in parts)
        cars = BatchedCars(configuration, device)
        generator = cars.generator(configuration.seed * 10 + _STREAM)
        return _Tuning(
            configuration, weights, networks, encoder, recorded, held_out, fitted, generator, cars, [held_out]
        )

    @property
    def history(self) -> int:
        return self.untuned.description.history

    def learn(self, sets: Sequence[Lived], updates: int, name: str, tell: Tell) -> None:
        """Adam on all sets alike; ends with the state whose held-out error was least."""
        phase = self.configuration.phase_3
        optimiser = torch.optim.Adam(self.fitted, phase.learning_rate)
        best, kept = math.inf, self._state()
        every = max(1, updates // _JUDGED)
        for done in range(updates):
            for group in optimiser.param_groups:
                group["lr"] = _rate(done / updates, phase.learning_rate, phase.last_learning_rate)
            losses = [self._loss(part, 1.0 / len(sets)) for part in sets]
            loss = torch.stack(losses).mean()
            optimiser.zero_grad(set_to_none=True)
            loss.backward()  # type: ignore[no-untyped-call]
            nn.utils.clip_grad_norm_(self.fitted, 1.0)
            optimiser.step()
            if (done + 1) % every == 0 or done + 1 == updates:
                judged = self._judged()
                tell(name, done + 1, updates, f"held-out error {judged:.3f}")
                if judged < best:
                    best, kept = judged, self._state()
        self._restore(kept)

    def _loss(self, part: Lived, share: float) -> Tensor:
        phase, history = self.configuration.phase_3, self.history
        index = part.draw(max(1, round(share * phase.batch)), self.generator)
        latent = self.encoder(part.histories(index, history))
        loss = one_step_loss(self.networks, latent, part, index)
        if phase.rollouts:
            count = max(1, round(share * phase.rollouts))
            starts = part.draw(count, self.generator, ahead=phase.horizon)
            loss = loss + rollout_loss(self.networks, self.encoder, part, starts, phase.horizon, history)
        if part.latents.shape[1]:
            loss = loss + phase.anchor * (latent - part.latents[index]).square().mean()
        return loss

    def imagine(self, count: int) -> Lived:
        """Drives of the robot as it is tuned now, under the configuration's environments."""
        phase = self.configuration.phase_3
        weights = self.untuned.with_tensors(self._tensors())
        return imagined_drives(
            self.cars, weights, self.networks, self.encoder, count, phase.steps, _CHANGE, self.generator
        )

    def spread(self, sets: Sequence[Lived]) -> None:
        """Sets the latent's range to what phi says of all data and a tenth more, its rest to the recorded middle."""
        seen = []
        with torch.no_grad():
            for part in sets:
                index = part.draw(5000, self.generator)
                seen.append(self.encoder(part.histories(index, self.history)))
            everything = torch.cat(seen)
            low, high = everything.amin(0), everything.amax(0)
            beyond = _BEYOND * (high - low)
            networks: Any = self.networks
            networks.latent_low.copy_(low - beyond)
            networks.latent_high.copy_(high + beyond)
            networks.latent_nominal.copy_(seen[0].mean(0))

    def held_out_errors(self) -> dict[str, dict[str, Any]]:
        """Root mean square of error / increment_scale, for each state and their mean, after one step and 20 steps."""
        found = errors(self.networks, self.encoder, self.held_out, HORIZON, self.history)
        names = self.untuned.description.states
        return {
            name: {"mean": float(values.mean()), "per_state": dict(zip(names, values.tolist(), strict=True))}
            for name, values in zip(("one_step", f"{HORIZON}_steps"), found, strict=True)
        }

    def _judged(self) -> float:
        """Sum of the one-step error and that per step of long rollouts, mean over what nothing is fitted to."""
        total = 0.0
        for part in self.judges:
            one, many = errors(self.networks, self.encoder, part, HORIZON, self.history, _STARTS)
            total += float(one.mean() + many.mean() / HORIZON) / len(self.judges)
        return total

    def weights(self, summary: dict[str, Any]) -> Weights:
        """The tuned weights with what they were tuned on."""
        from dataclasses import replace

        described = self.untuned.description
        trained_on = {**described.trained_on, "tuned": summary}
        return self.untuned.with_tensors(self._tensors(), replace(described, trained_on=trained_on))

    def _tensors(self) -> dict[str, np.ndarray[Any, Any]]:
        return {**tensors_of(self.networks), **tensors_of(self.encoder)}

    def _state(self) -> Any:
        return copy.deepcopy((self.networks.state_dict(), self.encoder.state_dict()))

    def _restore(self, kept: Any) -> None:
        self.networks.load_state_dict(kept[0])
        self.encoder.load_state_dict(kept[1])


def _fitted(networks: AffineNetworks, encoder: HistoryNetwork, what: What) -> list[nn.Parameter]:
    if what == "phi":
        return list(encoder.parameters())
    if what == "heads":
        phi: Any = encoder.phi
        return [*networks.f[-1].parameters(), *networks.g[-1].parameters(), *phi.out.parameters()]
    return [*networks.f.parameters(), *networks.g.parameters(), *encoder.parameters()]


def _lived(networks: AffineNetworks, drive: Drive, device: torch.device) -> Lived:
    states, actions = (
        torch.as_tensor(part, dtype=torch.float32, device=device).unsqueeze(0) for part in (drive.states, drive.actions)
    )
    return lived(networks, states, actions)


def _rate(done: float, highest: float, last: float) -> float:
    """Rises over the first twentieth, then falls along half a cosine."""
    if done < _WARM_UP:
        return highest * (done + 1e-3) / _WARM_UP
    return last + (highest - last) * 0.5 * (1.0 + math.cos(math.pi * (done - _WARM_UP) / (1.0 - _WARM_UP)))
