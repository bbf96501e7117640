"""Rehearsal: hides effects in simulated copies of the user's recordings and runs the diagnosis on them.

The simulated runs have the rows, commands, starts and noise of the given ones. The model is simulated open loop and
restarts from the measured state every few seconds, because no controller stabilises it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.diagnosis import diagnose as diagnosing
from safedpa.diagnosis.detectable import changed_values
from safedpa.diagnosis.diagnose import diagnose
from safedpa.diagnosis.fit.data_checks import MOST_ROWS, data_at_horizon, prepare_runs
from safedpa.diagnosis.fit.trial import with_effect_at
from safedpa.diagnosis.identifiability.check import IdentifiabilityCheck, check_identifiability
from safedpa.diagnosis.report_schema import Detectable
from safedpa.diagnosis.search.initial_model import initial_search
from safedpa.dynamics import PhysicsModel
from safedpa.effects import AbstractEffect
from safedpa.errors import InputError, did_you_mean
from safedpa.records.run import Run, Stretch

# Length [s] after which the simulation restarts at the measured state. An open-loop simulation drifts away from where
# the robot was, and then says little about its recordings.
_PIECE = 10.0
# A piece ends when a state leaves this multiple of its measured range: the simulation has diverged.
_MAX_RANGE = 1e3


@dataclass(frozen=True)
class RehearsalTrial:
    """One effect hidden at one size, and the result of the diagnosis of the simulated runs."""

    effect: str
    parameter: str
    unit: str
    size: float
    """Change from the neutral value."""
    predicted: bool
    """Whether the identifiability check predicts that it would be found."""
    found: bool
    """Whether the diagnosis names it, or an effect that it reports as indistinguishable."""
    named: tuple[str, ...]
    verdict: str


@dataclass(frozen=True)
class RehearsalResult:
    """Which effects would be found at which size."""

    check: IdentifiabilityCheck
    """The identifiability check of simulated runs in which nothing is hidden."""
    trials: tuple[RehearsalTrial, ...]

    @property
    def agreeing(self) -> int:
        """Number of trials in which the check predicted the result."""
        return sum(trial.predicted == trial.found for trial in self.trials)


def rehearse_diagnosis(
    model: PhysicsModel,
    runs: Sequence[Run],
    sizes: Sequence[float] = (1.0,),
    names: Sequence[str] = (),
    seed: int = 0,
    report_progress: Callable[[int, int], None] = lambda _done, _all: None,
) -> RehearsalResult:
    """Hides each effect of the library, or of ``names``, at each of ``sizes`` (in typical changes) and diagnoses it.

    Raises InputError for a name that the model could not lack, RunError for unusable runs.
    """
    library = _chosen(diagnosing.library_for(model), names)
    model = refitted_to_runs(model, runs)
    noise = measured_noise(runs)
    # Each simulation has its own seed, so that a result does not depend on which other effects are rehearsed.
    check = check_identifiability(model, list(simulate_runs(model, runs, noise, np.random.default_rng([seed, 0]))))
    chosen = [item for item in check.sizes if item.effect in {effect.name for effect in library}]
    jobs = [(item, size) for item in chosen for size in sizes]
    trials = []
    for number, (item, size) in enumerate(jobs):
        report_progress(number, len(jobs))
        hidden = next(effect for effect in library if effect.name == item.effect)
        random = np.random.default_rng([seed, number + 1])
        simulated = simulate_runs(_with_hidden_effect(model, hidden, item, size), runs, noise, random)
        trials.append(_trial(model, hidden, item, size, list(simulated)))
    report_progress(len(jobs), len(jobs))
    return RehearsalResult(check, tuple(trials))


def refitted_to_runs(model: PhysicsModel, runs: Sequence[Run]) -> PhysicsModel:
    """Fits the free parameters of the model to the runs.

    With a guess, the simulated robot drives in another regime than the real one. A gain that is three times too large
    takes a car without drag to 20 m/s within a piece, where steering effects look different.
    """
    if not model.latent_names:
        return model
    usable = prepare_runs(model, runs, MOST_ROWS)
    evidence = data_at_horizon(usable.runs, usable.seconds)
    return initial_search(model, evidence.shooting, evidence.heldout).first.fit.model


def _chosen(library: Sequence[AbstractEffect], names: Sequence[str]) -> list[AbstractEffect]:
    known = [item.name for item in library]
    for name in names:
        if name not in known:
            raise InputError(f"effect '{name}': not an effect that this model could lack; {did_you_mean(name, known)}")
    return [item for item in library if not names or item.name in names]


def _with_hidden_effect(model: PhysicsModel, item: AbstractEffect, size: Detectable, share: float) -> PhysicsModel:
    """Returns the model with one parameter of an effect moved away from its neutral value."""
    parameter = next(p for p in item.parameters if p.name == size.parameter)
    return with_effect_at(model, item, changed_values(item, parameter, share))


def _trial(
    model: PhysicsModel, item: AbstractEffect, size: Detectable, share: float, runs: Sequence[Run]
) -> RehearsalTrial:
    report = diagnose(model, runs)
    accepted = [candidate for candidate in report.candidates if candidate.decision == "accepted"]
    groups = {
        name for candidate in accepted for other in candidate.indistinguishable_from for name in other.split(" + ")
    }
    # An effect counts as found if the diagnosis names it or one that the data cannot distinguish from it.
    change = share * size.ordinary
    return RehearsalTrial(
        item.name,
        size.parameter,
        size.unit,
        change,
        size.smallest is not None and change >= size.smallest,
        item.name in report.added or item.name in groups,
        report.added,
        report.verdict,
    )


def measured_noise(runs: Sequence[Run]) -> FloatArray:
    """Returns a robust estimate of each state's white noise (states,), from second differences between rows.

    For white noise, x[k+1] - 2 x[k] + x[k-1] has sqrt(6) times its deviation. The motion of the robot is nearly linear
    over three rows.
    """
    parts = [np.diff(states, n=2, axis=0) for run in runs for _, states, _ in run.parts() if len(states) > 2]
    differences = np.concatenate(parts) if parts else np.zeros((1, len(runs[0].system.state)))
    # 1.4826 converts a median deviation to a standard deviation; the median ignores glitches.
    return np.asarray(1.4826 * np.median(np.abs(differences - np.median(differences, axis=0)), axis=0) / np.sqrt(6.0))


def simulate_runs(
    model: PhysicsModel, runs: Sequence[Run], noise: FloatArray, random: np.random.Generator
) -> Iterator[Run]:
    """Yields the runs as the model would have driven them with the same commands, with noise (states,)."""
    # With commands held over a period, as in the recordings.
    model = PhysicsModel(model.base, model.effects, model.settings, model.period, holds=True)
    for run in runs:
        states = run.states.copy()
        pieces = [piece for part in run.stretches for piece in _pieces(run, part)]
        retained = [Stretch(piece.start, _simulate_piece(model, run, piece, states)) for piece in pieces]
        states = states + noise * random.standard_normal(states.shape)
        yield replace(run, states=states, stretches=tuple(part for part in retained if len(part) > 2), findings=())


def _pieces(run: Run, part: Stretch) -> list[Stretch]:
    rows = max(3, round(_PIECE / run.period))
    count = max(1, len(part) // rows)
    edges = [part.start + len(part) * number // count for number in range(count + 1)]
    return [Stretch(low, high) for low, high in pairwise(edges)]


def _simulate_piece(model: PhysicsModel, run: Run, piece: Stretch, states: FloatArray) -> int:
    """Simulates a piece and writes its states; returns the row after the last usable one."""
    # The 1 covers states that did not move at all in the recording.
    most = _MAX_RANGE * (np.ptp(run.states, axis=0) + 1.0)
    memory = model.initial_memory(run.actions[piece.start])
    for row in range(piece.start, piece.stop - 1):
        period, time = float(run.t[row + 1] - run.t[row]), float(run.t[row] - run.t[0])
        states[row + 1], memory = model.advance(states[row], run.actions[row], memory, period=period, time=time)
        if not (np.isfinite(states[row + 1]).all() and (np.abs(states[row + 1] - run.states[0]) < most).all()):
            return row + 1
    return piece.stop
