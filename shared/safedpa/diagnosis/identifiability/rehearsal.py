"""A diagnosis rehearsed: effects hidden in one's own drives, simulated with the noise of one's logs, and looked for.

The logs of the rehearsal have the rows, commands and starts of the given ones. The model drives them open loop, again
from the measured state every few seconds, so that what holds a real robot upright does not have to.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.diagnosis.diagnose import diagnose, library_for
from safedpa.diagnosis.fit.data_checks import MOST_ROWS, prepare_runs
from safedpa.diagnosis.fit.horizon import data_at_horizon
from safedpa.diagnosis.identifiability.check import IdentifiabilityCheck, check_identifiability
from safedpa.diagnosis.report_schema import Detectable
from safedpa.diagnosis.search.initial_model import initial_search
from safedpa.dynamics import PhysicsModel, Setting
from safedpa.effects import AbstractEffect
from safedpa.errors import InputError, did_you_mean
from safedpa.records.run import Run, Stretch

__all__ = [
    "RehearsalResult",
    "RehearsalTrial",
    "measured_noise",
    "refitted_to_runs",
    "rehearse_diagnosis",
    "simulate_runs",
]

_PIECE = 10.0
"""s; after so long the simulation begins again where the robot was."""
_FARTHEST = 1e3
"""Times its usual range a simulated state may reach before its piece ends."""


@dataclass(frozen=True)
class RehearsalTrial:
    """One effect hidden at one size, and what a diagnosis of the simulated logs says."""

    effect: str
    parameter: str
    unit: str
    size: float
    """Change from doing nothing."""
    predicted: bool
    """Whether the sensitivities say that it would be found."""
    found: bool
    """Named, or in the group of what is named."""
    named: tuple[str, ...]
    verdict: str


@dataclass(frozen=True)
class RehearsalResult:
    """What would be found at which size."""

    check: IdentifiabilityCheck
    """Of logs in which nothing is hidden."""
    trials: tuple[RehearsalTrial, ...]

    @property
    def agreeing(self) -> int:
        """Trials in which the prediction was right."""
        return sum(trial.predicted == trial.found for trial in self.trials)


def rehearse_diagnosis(
    model: PhysicsModel,
    runs: Sequence[Run],
    sizes: Sequence[float] = (1.0,),
    names: Sequence[str] = (),
    seed: int = 0,
    report_progress: Callable[[int, int], None] = lambda _done, _all: None,
) -> RehearsalResult:
    """Hides each effect of the library, or of ``names``, in each of ``sizes``, in ordinary changes, and diagnoses.

    Raises InputError for a name that the model could not lack, RunError for unusable runs.
    """
    library = _chosen(library_for(model), names)
    model = refitted_to_runs(model, runs)
    noise = measured_noise(runs)
    check = check_identifiability(model, list(simulate_runs(model, runs, noise, np.random.default_rng([seed, 0]))))
    chosen = [item for item in check.sizes if item.effect in {own.name for own in library}]
    jobs = [(item, size) for item in chosen for size in sizes]
    trials = []
    for number, (item, size) in enumerate(jobs):
        report_progress(number, len(jobs))
        own = next(effect for effect in library if effect.name == item.effect)
        random = np.random.default_rng([seed, number + 1])
        trials.append(
            _trial(model, own, item, size, list(simulate_runs(_with(model, own, item, size), runs, noise, random)))
        )
    report_progress(len(jobs), len(jobs))
    return RehearsalResult(check, tuple(trials))


def refitted_to_runs(model: PhysicsModel, runs: Sequence[Run]) -> PhysicsModel:
    """The model with its free numbers fitted to the runs.

    With a guess the robot of the rehearsal drives elsewhere than the real one: a gain that is three times too large
    takes a car without drag to 20 m/s within a piece, and what such a drive shows of a steering says nothing of these.
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
            raise InputError(f"effect '{name}': nothing that this model could lack; {did_you_mean(name, known)}")
    return [item for item in library if not names or item.name in names]


def _with(model: PhysicsModel, item: AbstractEffect, size: Detectable, share: float) -> PhysicsModel:
    """The model with one number of an effect moved away from doing nothing."""
    values = {p.name: p.typical if p.neutral is None else p.neutral for p in item.parameters}
    parameter = next(p for p in item.parameters if p.name == size.parameter)
    neutral = parameter.neutral or 0.0
    side = -1.0 if parameter.typical < neutral else 1.0
    values[parameter.name] = float(np.clip(neutral + side * share * size.ordinary, parameter.low, parameter.high))
    return model.with_effect(item, {name: Setting(value) for name, value in values.items()})


def _trial(
    model: PhysicsModel, item: AbstractEffect, size: Detectable, share: float, runs: Sequence[Run]
) -> RehearsalTrial:
    report = diagnose(model, runs)
    own = [candidate for candidate in report.candidates if candidate.decision == "accepted"]
    groups = {name for candidate in own for other in candidate.indistinguishable_from for name in other.split(" + ")}
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
    """Standard deviation of each state's white noise (states,): robust, from second differences between rows.

    x[k+1] - 2 x[k] + x[k-1] of white noise has sqrt(6) times its deviation; the robot's own motion hardly bends within
    three rows.
    """
    parts = [np.diff(states, n=2, axis=0) for run in runs for _, states, _ in run.parts() if len(states) > 2]
    bent = np.concatenate(parts) if parts else np.zeros((1, len(runs[0].system.state)))
    return np.asarray(1.4826 * np.median(np.abs(bent - np.median(bent, axis=0)), axis=0) / np.sqrt(6.0))


def simulate_runs(
    model: PhysicsModel, runs: Sequence[Run], noise: FloatArray, random: np.random.Generator
) -> Iterator[Run]:
    """The runs as the model would have driven them under the same commands, with noise (states,)."""
    model = PhysicsModel(model.base, model.effects, model.settings, model.period, holds=True)
    for run in runs:
        states = run.states.copy()
        pieces = [piece for part in run.stretches for piece in _pieces(run, part)]
        retained = [Stretch(piece.start, _driven(model, run, piece, states)) for piece in pieces]
        states = states + noise * random.standard_normal(states.shape)
        yield replace(run, states=states, stretches=tuple(part for part in retained if len(part) > 2), findings=())


def _pieces(run: Run, part: Stretch) -> list[Stretch]:
    rows = max(3, round(_PIECE / run.period))
    count = max(1, len(part) // rows)
    edges = [part.start + len(part) * number // count for number in range(count + 1)]
    return [Stretch(low, high) for low, high in pairwise(edges)]


def _driven(model: PhysicsModel, run: Run, piece: Stretch, states: FloatArray) -> int:
    """Writes the states of a piece; returns the row behind the last that can be used."""
    most = _FARTHEST * (np.ptp(run.states, axis=0) + 1.0)
    memory = model.initial_memory(run.actions[piece.start])
    for row in range(piece.start, piece.stop - 1):
        period, time = float(run.t[row + 1] - run.t[row]), float(run.t[row] - run.t[0])
        states[row + 1], memory = model.advance(states[row], run.actions[row], memory, period=period, time=time)
        if not (np.isfinite(states[row + 1]).all() and (np.abs(states[row + 1] - run.states[0]) < most).all()):
            return row + 1
    return piece.stop
