"""Phase 3: f, g and phi, tuned on little data from the real robot.

Networks that are tuned only on drives without load forget the effect of loads, because nothing in these drives
preserves it. A physics model does not forget: its effects compose. Therefore the recorded data first correct the
simulator: its parameters are refitted, and effects are added until the diagnosis finds nothing missing. Simulated
drives with loads and wind are then mixed with the recorded ones. The loss uses z = phi(history), so that z also encodes
the state of motor and steering:

    one-step error + error of short rollouts in which phi sees the predictions + anchor |phi - mu(e)|^2

Part of the recorded data is held out. The state with the smallest held-out error wins, and tuning fails unless it beats
the untuned networks there. Source: Xiao et al., Safe Deep Policy Adaptation, ICRA 2024, phase 3; the corrected
simulator, the rollouts and the anchor are additions of this project.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal, final

import numpy as np
import torch
from torch import nn

from safedpa.diagnosis.diagnose import diagnose
from safedpa.diagnosis.report_schema import Report
from safedpa.dynamics import PhysicsModel, Setting
from safedpa.effects import effect
from safedpa.errors import InputError
from safedpa.networks import Weights
from safedpa.networks.weights import STRIDE
from safedpa.records import Run, Stretch
from safedpa_sim.training.configuration import Configuration
from safedpa_sim.training.data.drives import random_drives
from safedpa_sim.training.data.recorded_runs import (
    HORIZON,
    TuningDrive,
    drives_of,
    load_tuning_runs,
    record_circles,
    split,
)
from safedpa_sim.training.data.transitions import TransitionSequence, concatenate, transition_sequence
from safedpa_sim.training.environments.batched_simulator import BatchedSimulator
from safedpa_sim.training.networks.modules import (
    AffineNetworks,
    HistoryNetwork,
    affine_networks,
    history_network,
    tensors_of,
)
from safedpa_sim.training.networks.prediction_errors import (
    ALONG,
    along,
    errors,
    latents_along,
    one_step_loss,
    rollout_loss,
)
from safedpa_sim.training.optimisation import cosine_rate, training_device
from safedpa_sim.training.progress import ReportProgress, silent

Tensor = torch.Tensor
What = Literal["all", "phi", "heads"]
WHAT: Final = ("all", "phi", "heads")
"""What is tuned: f, g and phi; phi alone; or the last layer of each of the three."""
_STREAM = 7
"""Random stream of this phase: its seed is seed * 10 + this number."""
_CHANGE = 0.005
"""Probability per period that the environment changes in the simulator."""
_JUDGED = 10
"""Number of evaluations of the held-out error during training."""
_ROLLOUT_WEIGHT = 2.0
"""Weight of rollouts relative to single steps. Few updates have rollouts: they take four times as long as the rest."""
_SAMPLES = 5000
_STARTS = 256
"""Rollouts per evaluation of the held-out error."""
_JUDGING = 10
"""Simulated training drives per held-out simulated drive."""
_BEYOND = 0.1
"""Share of the latent's range that is added at each end to the range seen in tuning."""
_WARM_UP = 0.05
"""Share of the updates in which the learning rate rises."""


def tune(
    configuration: Configuration,
    weights: Weights,
    out: Path,
    report_progress: ReportProgress = silent,
    device: str = "cpu",
) -> tuple[Weights, dict[str, Any]]:
    """Records circles without load from the pymunk car and tunes f, g and phi on them; see ``tune_on_drives``."""
    del out
    phase = configuration.phase_3
    runs = record_circles(phase.pairs, configuration.seed * 10 + _STREAM, phase.run_pairs)
    drives = drives_of(runs, weights)
    return tune_on_drives(configuration, weights, drives, "all", report_progress, device, runs="circles without load")


def tune_on_runs(
    configuration: Configuration,
    weights: Weights,
    runs: Sequence[Path],
    columns: Path | None,
    out: Path,
    report_progress: ReportProgress = silent,
    what: str = "all",
) -> tuple[Weights, dict[str, Any]]:
    """Tunes on recorded files; see ``load_tuning_runs`` for the requirements on them, and ``tune_on_drives``."""
    del out
    if what not in WHAT:
        raise InputError(f"--what: got '{what}', wanted one of {', '.join(WHAT)}")
    drives = load_tuning_runs(runs, columns, configuration.simulator.system, weights)
    names = ", ".join(path.name for path in runs)
    return tune_on_drives(configuration, weights, drives, what, report_progress, runs=names)  # type: ignore[arg-type]


def tune_on_drives(
    configuration: Configuration,
    weights: Weights,
    drives: Sequence[TuningDrive],
    what: What = "all",
    report_progress: ReportProgress = silent,
    device: str = "cpu",
    *,
    runs: str = "drives",
) -> tuple[Weights, dict[str, Any]]:
    """Tunes the weights on drives and returns them with the held-out errors before and after.

    ``runs`` describes the drives in the summary. Raises InputError when the weights have no history encoder, when there
    is too little data to hold out, or when tuning does not reduce the held-out error.
    """
    if not weights.has("phi"):
        raise InputError("weights: no history encoder (phi) in them, wanted one to tune; run phase 2 first")
    training = _Tuning(configuration, weights, drives, what, training_device(device))
    before = training.held_out_errors()
    corrected = training.add_simulated(report_progress)
    training.learn(report_progress)
    training.spread()
    after = training.held_out_errors()
    summary = {
        "runs": runs,
        "what": what,
        "mended_simulator": corrected,
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
class _Tuning:
    def __init__(
        self,
        configuration: Configuration,
        weights: Weights,
        drives: Sequence[TuningDrive],
        what: What,
        device: torch.device,
    ) -> None:
        self.configuration, self.untuned = configuration, weights
        self.networks, self.encoder = affine_networks(weights).to(device), history_network(weights).to(device)
        self.networks.requires_grad_(False)
        self.encoder.requires_grad_(False)
        self.fitted = _fitted(self.networks, self.encoder, what)
        for parameter in self.fitted:
            parameter.requires_grad_(True)
        self.drives, kept_apart = split(drives, weights.description.history)
        self.recorded, self.held_out = (
            concatenate([_sequence(self.networks, drive, device) for drive in part])
            for part in (self.drives, kept_apart)
        )
        self.generator = torch.Generator(device).manual_seed(configuration.seed * 10 + _STREAM)
        self.simulated: TransitionSequence | None = None
        self.judges = [self.held_out]
        """The held-out parts of the recorded and of the simulated data."""

    @property
    def history(self) -> int:
        return self.untuned.description.history

    def add_simulated(self, report_progress: ReportProgress) -> dict[str, Any]:
        """Corrects the simulator and simulates drives in it; returns the corrections, or why there are none."""
        phase = self.configuration.phase_3
        if not phase.cars or not self.untuned.has("mu"):
            return {"none": "tuned on recorded data alone"}
        try:
            grounded = ground_simulator(self.configuration, self._runs(), report_progress)
        except InputError as error:
            return {"none": str(error), "warning": f"loads may be forgotten: the simulator was not corrected ({error})"}
        cars = BatchedSimulator(grounded_configuration(self.configuration, grounded), self.generator.device)
        self.simulated, judge = (
            random_drives(cars, self.networks, count, phase.steps, _CHANGE, self.generator, swinging=True)
            for count in (phase.cars, max(1, phase.cars // _JUDGING))
        )
        self.judges.append(judge)
        return grounded.summary()

    def _runs(self) -> list[Run]:
        """Returns the recorded training drives as runs, the input of the diagnosis."""
        period, system = self.untuned.description.period, self.configuration.simulator.system
        runs = []
        for number, (states, actions) in enumerate(self.drives):
            rows = len(states)
            t = period * np.arange(rows, dtype=np.float64)
            held = np.concatenate((actions, actions[-1:]))
            runs.append(Run(f"drive {number}", system, t, states, held, (Stretch(0, rows),)))
        return runs

    def learn(self, report_progress: ReportProgress) -> None:
        """Trains by Adam on recorded and simulated drives, then restores the state with the least held-out error."""
        phase = self.configuration.phase_3
        optimiser = torch.optim.Adam(self.fitted, phase.learning_rate)
        best, retained = math.inf, self._state()
        every = max(1, phase.updates // _JUDGED)
        for done in range(phase.updates):
            for group in optimiser.param_groups:
                group["lr"] = _rate(done / phase.updates, phase.learning_rate, phase.last_learning_rate)
            rollouts = done % phase.rollout_every == 0
            loss = self._loss(self.recorded, 1.0 if self.simulated is None else phase.recorded, rollouts)
            if self.simulated is not None:
                loss = loss + self._loss(self.simulated, 1.0 - phase.recorded, rollouts)
            optimiser.zero_grad(set_to_none=True)
            loss.backward()  # type: ignore[no-untyped-call]
            nn.utils.clip_grad_norm_(self.fitted, 1.0)
            optimiser.step()
            if (done + 1) % every == 0 or done + 1 == phase.updates:
                judged = self._judged()
                report_progress("3", done + 1, phase.updates, f"held-out error {judged:.3f}")
                if judged < best:
                    best, retained = judged, self._state()
        self._restore(retained)

    def _loss(self, part: TransitionSequence, share: float, rollouts: bool) -> Tensor:
        """Returns the loss over one part of the batch, weighted by its share of the batch."""
        phase, history = self.configuration.phase_3, self.history
        segments = max(1, round(share * phase.batch / ALONG))
        start = part.draw(segments, self.generator, ahead=(ALONG - 1) * STRIDE + 1)
        rows = part.histories(start, history, (ALONG - 1) * STRIDE)
        latent, index = latents_along(self.encoder, rows, ALONG).flatten(0, 1), along(start)
        loss = one_step_loss(self.networks, latent, part, index)
        if rollouts and phase.rollouts:
            starts = part.draw(max(1, round(share * phase.rollouts)), self.generator, ahead=phase.horizon)
            far = rollout_loss(self.networks, self.encoder, part, starts, phase.horizon, history)
            loss = loss + _ROLLOUT_WEIGHT * far
        if part.latents.shape[1]:
            loss = loss + phase.anchor * (latent - part.latents[index]).square().mean()
        return share * loss

    def spread(self) -> None:
        """Sets the latent's range to phi's range over all data plus a tenth, its nominal value to the recorded mean.

        The range includes 0, because fits of the latent start there, with a quarter of the range as the first step.
        """
        sets = [self.recorded] if self.simulated is None else [self.recorded, self.simulated]
        seen = []
        with torch.no_grad():
            for part in sets:
                index = part.draw(_SAMPLES, self.generator)
                seen.append(self.encoder(part.histories(index, self.history)))
            everything = torch.cat(seen)
            low, high = everything.amin(0), everything.amax(0)
            beyond = _BEYOND * (high - low)
            lowest = (low - beyond).clamp_max(0.0)
            networks: Any = self.networks
            networks.latent_low.copy_(lowest)
            # The first step of a fit, a quarter of the range from 0 upwards, must stay within the range.
            networks.latent_high.copy_(torch.maximum(high + beyond, -lowest / 3.0))
            networks.latent_nominal.copy_(seen[0].mean(0))

    def held_out_errors(self) -> dict[str, dict[str, Any]]:
        """Returns the RMS of error / increment_scale after one step and after 20, for each state and their mean."""
        found = errors(self.networks, self.encoder, self.held_out, HORIZON, self.history)
        names = self.untuned.description.states
        return {
            name: {"mean": float(values.mean()), "per_state": dict(zip(names, values.tolist(), strict=True))}
            for name, values in zip(("one_step", f"{HORIZON}_steps"), found, strict=True)
        }

    def _judged(self) -> float:
        """Returns one-step error + rollout error per step, averaged over the held-out parts."""
        total = 0.0
        for part in self.judges:
            one, many = errors(self.networks, self.encoder, part, HORIZON, self.history, _STARTS)
            total += float(one.mean() + many.mean() / HORIZON) / len(self.judges)
        return total

    def weights(self, summary: dict[str, Any]) -> Weights:
        """Returns the tuned weights; their description records the tuning."""
        described = self.untuned.description
        trained_on = {**described.trained_on, "tuned": summary}
        return self.untuned.with_tensors(self._tensors(), replace(described, trained_on=trained_on))

    def _tensors(self) -> dict[str, np.ndarray[Any, Any]]:
        return {**tensors_of(self.networks), **tensors_of(self.encoder)}

    def _state(self) -> Any:
        return copy.deepcopy((self.networks.state_dict(), self.encoder.state_dict()))

    def _restore(self, retained: Any) -> None:
        self.networks.load_state_dict(retained[0])
        self.encoder.load_state_dict(retained[1])


def _fitted(networks: AffineNetworks, encoder: HistoryNetwork, what: What) -> list[nn.Parameter]:
    if what == "phi":
        return list(encoder.parameters())
    if what == "heads":
        phi: Any = encoder.phi
        return [*networks.f[-1].parameters(), *networks.g[-1].parameters(), *phi.out.parameters()]
    return [*networks.f.parameters(), *networks.g.parameters(), *encoder.parameters()]


def _sequence(networks: AffineNetworks, drive: TuningDrive, device: torch.device) -> TransitionSequence:
    states, actions = (
        torch.as_tensor(part, dtype=torch.float32, device=device).unsqueeze(0) for part in (drive.states, drive.actions)
    )
    return transition_sequence(networks, states, actions)


def _rate(done: float, highest: float, last: float) -> float:
    """Returns the learning rate: linear warm-up over the first 5 % of the updates, then a cosine decay."""
    if done < _WARM_UP:
        return highest * (done + 1e-3) / _WARM_UP
    return cosine_rate(highest, last, done - _WARM_UP, 1.0 - _WARM_UP)


_ROWS = 6000


@final
@dataclass(frozen=True)
class GroundedSimulator:
    """The corrected simulator and the diagnosis report behind it."""

    model: PhysicsModel
    report: Report

    def summary(self) -> dict[str, Any]:
        """Returns verdict, added effects in order, held-out error after each, and parameters for the record."""
        return {
            "verdict": self.report.verdict,
            "effects": list(self.report.added),
            "heldout_error": [stage.heldout_error for stage in self.report.stages],
            "parameters": {path: value.value for path, value in self.report.parameters.items()},
        }


def ground_simulator(
    configuration: Configuration, runs: Sequence[Run], report_progress: ReportProgress = silent
) -> GroundedSimulator:
    """Refits the parameters of the simulator's base to the runs and adds the effects that the diagnosis finds.

    Effects that the training randomises, such as a towed load, are in the model from the start with neutral values, so
    that the diagnosis does not search for them: the runs are recorded without them. Raises InputError when the
    diagnosis reaches no verdict on the runs.
    """
    report = diagnose(
        _to_be_corrected(configuration),
        _first(runs, _ROWS),
        report_progress=lambda done, every, notice: report_progress(
            "3", done, every, f"diagnosis of the simulator; {notice}"
        ),
    )
    too_few = report.verdict == "undecided" and report.unexplained is not None and not report.added
    if too_few or (report.verdict == "unexplained" and not report.added):
        why = report.unexplained.expression if report.unexplained else "nothing helps"
        raise InputError(
            f"tuning: the runs are not informative enough to correct the simulator ({why}); record a more varied drive"
        )
    found = report.models[-1]
    return GroundedSimulator(
        found.with_settings({path: Setting(it.value) for path, it in found.settings.items()}), report
    )


def grounded_configuration(configuration: Configuration, grounded: GroundedSimulator) -> Configuration:
    """Returns the configuration with the corrected simulator."""
    return replace(configuration, simulator=grounded.model)


def _to_be_corrected(configuration: Configuration) -> PhysicsModel:
    model = configuration.simulator
    for name in dict.fromkeys(path.split(".")[0] for path in configuration.environment):
        if name != "base" and name not in {item.name for item in model.effects}:
            model = model.with_effect(effect(model.system.name, name), {})
    base = {path: it for path, it in model.settings.items() if path.startswith("base.")}
    return model.with_settings({path: Setting(it.value, free=True) for path, it in base.items()})


def _first(runs: Sequence[Run], rows: int) -> list[Run]:
    """Returns the first runs that together have ``rows`` rows; ten times as many only make the diagnosis slower."""
    retained, total = [], 0
    for run in runs:
        retained.append(run)
        total += sum(len(part) for part in run.stretches)
        if total >= rows:
            break
    return retained
