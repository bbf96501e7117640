"""Final numbers: the parameters that make the innovations of a Kalman filter along whole recordings smallest.

minimise sum over the rows of e' S^-1 e + log det S, e the innovations, S their covariance; the noise of the
measurement and lasting disturbances of the rates are estimated next to the parameters. Windows with starts of their own,
on which the search works, mistake part of a lasting disturbance for a parameter: a window's start already shows it.

Source: Ljung, System Identification, 2nd ed., 1999, sections 7.4 and 9.4 (covariance of prediction-error estimates);
Liang and Zeger, Biometrika 73, 1986 (sandwiches over groups).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray, IndexArray
from safedpa.comparison.rollout import effective_actions_by_name
from safedpa.comparison.side_by_side import StackedMechanics
from safedpa.comparison.where import PLACE
from safedpa.comparison.windows import Windows
from safedpa.diagnosis.fit.kalman import Innovations, LinearizedTrajectory, Noise, kalman_innovations
from safedpa.diagnosis.fit.least_squares import (
    bounds_of,
    difference_step,
    regularized_inverse,
    typical_change,
    with_values,
)
from safedpa.dynamics import PhysicsModel
from safedpa.dynamics.base import AbstractBase
from safedpa.effects import CommandEffect, Conditioned, Where

__all__ = ["PredictionErrorFit", "prediction_error_fit"]

_PIECE, _SETTLING = 8.0, 1.0
"""s; a piece, and the time before it in which the filter settles."""
_FEWEST_PIECES = 2
_NOISE_PIECES = 16
_NEWTON = (3, 1, 1, 1, 1, 1)
"""Newton's steps for the noise, round by round."""
_ODD = 4.0
"""Standard deviations beyond which an innovation counts as this many."""
_SUBSTEPS = (4, 4, 16)
"""Steps of integration in a row, round by round: dry friction is rounded off over as small a part of what one needs."""
_ROUGH = 3
"""Rounds, up to which a tenth of a number does not matter, and the finest steps are left out."""
_MOST_ROWS = 16_000
"""Of longer logs evenly spread pieces are used."""
_TANGENT = 1e-4
_FEWEST_RUNS = 4
"""Runs whose differences say how sure a number is."""
_NUMERICAL = 2e-4
"""Share of a number that integration leaves open: long quiet recordings put dead zones, forces and frictions within
5e-5 of themselves, and 1.3e-4 to 2.3e-4 off."""
_BORDER = 0.1
"""Of the width over which a condition sets in: borders of sharp edges came out 2 to 4 mm off a width of 50."""


@dataclass(frozen=True)
class PredictionErrorFit:
    """A model with final numbers (paths,) and their standard deviations, NaN where a number was not free."""

    model: PhysicsModel
    paths: tuple[str, ...]
    deviations: FloatArray
    noise: Noise


def prediction_error_fit(
    model: PhysicsModel, paths: Sequence[str], free: NDArray[np.bool_], windows: Windows, rounds: int = len(_NEWTON)
) -> PredictionErrorFit | None:
    """The parameters ``paths`` of a model from where they stand, those that are ``free`` (paths,).

    Three ``rounds`` do where a tenth of a number does not matter.

    None where the recordings are in pieces too short for a filter, or no covariance stays positive.
    """
    try:
        return _refined(model, paths, free, windows, rounds)
    except np.linalg.LinAlgError:
        return None


def _refined(
    model: PhysicsModel, paths: Sequence[str], free: NDArray[np.bool_], windows: Windows, rounds: int
) -> PredictionErrorFit | None:
    chosen = [path for path, own in zip(paths, free.tolist(), strict=True) if own]
    pieces = _pieces(windows)
    if len(pieces.rows) < _FEWEST_PIECES:
        return None
    reference = windows.states[pieces.rows].copy()
    noise, doubt = _first_noise(model, windows), np.ones(reference.shape)
    for turn in range(rounds):
        finest = len(_SUBSTEPS) - (1 if rounds > _ROUGH else 2)
        substeps = _SUBSTEPS[min(turn, finest)] if _integrated(model) else 1
        track = _track(model, chosen, _Steps(windows, pieces, substeps), reference, doubt, noise.measured[0])
        noise = _better_noise(track, noise, _NEWTON[turn])
        found = kalman_innovations(track, noise)
        shift = _shift(model, chosen, found)
        reference = reference + found.states
        doubt = np.maximum(1.0, np.abs(found.ratio) * doubt / _ODD)
        model, before = _shifted(model, chosen, shift), model
        if turn > 1 and _settled(before, model, chosen, found):
            break
    deviations = np.full(len(paths), np.nan)
    deviations[np.asarray(free, dtype=bool)] = np.hypot(
        _deviations(model, chosen, found, _runs_of(pieces, windows)), _numerical(model, chosen)
    )
    return PredictionErrorFit(model, tuple(paths), deviations, noise)


@dataclass(frozen=True)
class _Pieces:
    """Rows of the table (pieces, rows), the last one repeated where a piece is shorter."""

    rows: IndexArray
    inside: NDArray[np.bool_]
    counted: NDArray[np.bool_]


def _pieces(windows: Windows) -> _Pieces:
    period = float(np.median(windows.period))
    length, before = max(4, round(_PIECE / period)), max(1, round(_SETTLING / period))
    spans = []
    for begin, stop in windows.bounds.tolist():
        for core in range(begin + before, stop - 2, length):
            spans.append((core - before, core, min(core + length, stop)))
    most = max(4, _MOST_ROWS // (length + before))
    spans = [spans[i] for i in np.unique(np.linspace(0, len(spans) - 1, min(most, len(spans))).astype(int))]
    starts, cores, stops = np.array(spans, dtype=np.int64).reshape(-1, 3).T
    rows = starts[:, None] + np.arange(length + before)
    inside = rows < stops[:, None]
    return _Pieces(np.minimum(rows, stops[:, None] - 1), inside, inside & (rows >= cores[:, None]))


@dataclass(frozen=True)
class _Steps:
    """One step of a model from every row of the pieces."""

    windows: Windows
    pieces: _Pieces
    substeps: int

    def ahead(self, model: PhysicsModel, states: FloatArray) -> FloatArray:
        """States one row later, (pieces, rows, states)."""
        flat = self.pieces.rows.reshape(-1)
        finer = self.substeps if _remembers(model) else 1
        felt = effective_actions_by_name(model, self.finer if finer > 1 else self.windows)
        mechanics, now = StackedMechanics([model]), list(states.reshape(len(flat), -1).T)
        seconds = self.windows.period[flat] / self.substeps
        action = [column[finer * flat] for column in felt]
        with np.errstate(all="ignore"):
            for part in range(self.substeps):
                if part and finer > 1:
                    action = [column[finer * flat + part] for column in felt]
                now = mechanics.ahead(now, action, seconds, self.windows.time[flat] + part * seconds)
        return np.clip(np.nan_to_num(np.stack(now, axis=-1)), -1e6, 1e6).reshape(states.shape)

    @cached_property
    def finer(self) -> Windows:
        """The table with every row divided: what a lag or a delay makes of a command changes within a row."""
        own, parts = self.windows, self.substeps
        period, actions = np.repeat(own.period / parts, parts), np.repeat(own.actions, parts, axis=0)
        return replace(own, period=period, actions=actions, bounds=own.bounds * parts, memo={})


def _remembers(model: PhysicsModel) -> bool:
    """Whether what the mechanics feel depends on commands before this row."""
    names = dict.fromkeys(model.system.action_names, 0.0)
    commands = [item for item in model.effects if isinstance(item, CommandEffect)]
    return any(item.initial_memory(names) is not None for item in commands)


def _integrated(model: PhysicsModel) -> bool:
    """Whether its rates are integrated: a learned change over a period has no parts."""
    return type(model.base).integrate is AbstractBase.integrate


def _track(
    model: PhysicsModel,
    paths: Sequence[str],
    step: _Steps,
    reference: FloatArray,
    doubt: FloatArray,
    noise: FloatArray,
) -> LinearizedTrajectory:
    """The model about the reference: one step from every row, and its slopes by differences."""
    size = reference.shape[-1]
    steps = [difference_step(model.parameters[path], model.settings[path].value) for path in paths]
    nearby = [with_values(model, {p: model.settings[p].value + s}) for p, s in zip(paths, steps, strict=True)]
    ahead = step.ahead(model, reference)
    shifted = [step.ahead(model, reference + _TANGENT * np.eye(size)[i]) for i in range(size)]
    varied = [(step.ahead(own, reference) - ahead) / s for own, s in zip(nearby, steps, strict=True)]
    transition = np.stack([(one - ahead) / _TANGENT for one in shifted], axis=-1)
    onward = np.concatenate([reference[:, 1:], reference[:, -1:]], axis=1)
    system = step.windows.system
    difference = system.difference
    return LinearizedTrajectory(
        transition=transition,
        bent=_bent(model, step, reference, ahead, transition, noise),
        drift=difference(ahead, onward),
        columns=np.stack(varied, axis=-1) if varied else np.zeros((*reference.shape, 0)),
        seen=difference(step.windows.states[step.pieces.rows], reference),
        period=step.windows.period[step.pieces.rows],
        inside=step.pieces.inside,
        counted=step.pieces.counted,
        doubt=doubt,
        disturbed=np.array([i for i, v in enumerate(system.state) if v.name not in PLACE], dtype=np.int64),
    )


def _bent(
    model: PhysicsModel,
    step: _Steps,
    reference: FloatArray,
    ahead: FloatArray,
    transition: FloatArray,
    noise: FloatArray,
) -> FloatArray:
    """|model(x + e) - model(x) - T e|, the largest over steps e of one deviation of the measurement either way."""
    largest = np.zeros(reference.shape)
    for index, size in enumerate(noise.tolist()):
        if step.windows.system.state_names[index] in PLACE:
            continue
        for part in (-size, size):
            shift = part * np.eye(len(noise))[index]
            change = step.ahead(model, reference + shift) - ahead
            largest = np.maximum(largest, np.abs(change - part * transition[..., index]))
    return largest


def _first_noise(model: PhysicsModel, windows: Windows) -> Noise:
    """The measurement's noise from third differences of neighbouring rows, disturbances of a like size a second."""
    del model
    states = windows.states
    difference = windows.system.difference
    jumps = difference(states[1:], states[:-1])
    third = np.diff(jumps, n=2, axis=0)
    measured = np.maximum(np.median(np.abs(third), axis=0) * 1.4826 / np.sqrt(20.0), 1e-6)
    disturbed = [i for i, v in enumerate(windows.system.state) if v.name not in PLACE]
    return Noise(measured[None], 3.0 * measured[disturbed][None], np.ones(1))


def _better_noise(track: LinearizedTrajectory, noise: Noise, rounds: int) -> Noise:
    """Newton's steps for the logarithms of the noise, each by itself, on some of the pieces."""
    pick = np.unique(np.linspace(0, len(track.seen) - 1, _NOISE_PIECES).astype(int))
    part = replace(
        track,
        **{
            name: getattr(track, name)[pick]
            for name in ("transition", "drift", "columns", "seen", "period", "inside", "counted", "doubt", "bent")
        },
    )
    now = np.log(np.concatenate([noise.measured[0], noise.pushes[0], noise.seconds]))
    states, width = noise.measured.shape[-1], 0.2
    for _ in range(rounds):
        eye = width * np.eye(len(now))
        cost = kalman_innovations(
            part, _noise_of(np.concatenate([now[None], now + eye, now - eye]), states), slopes=False
        ).cost
        up, down = cost[1 : 1 + len(now)], cost[1 + len(now) :]
        slope, curvature = (up - down) / (2 * width), (up + down - 2 * cost[0]) / width**2
        step = -slope / np.maximum(curvature, 0.5 * np.abs(slope) + 1.0)
        steps = np.clip(step, -2.0, 2.0) * np.array([[1.0], [0.5], [0.2], [0.0]])
        tried = now + steps
        tried[:, -1] = np.clip(tried[:, -1], np.log(0.1), np.log(10.0))
        cost = kalman_innovations(part, _noise_of(tried, states), slopes=False).cost
        now = tried[int(np.argmin(cost))]
    return _noise_of(now[None], states)


def _noise_of(logs: FloatArray, states: int) -> Noise:
    values = np.exp(np.clip(logs, -16.0, 8.0))
    return Noise(values[:, :states], values[:, states:-1], values[:, -1])


def _shift(model: PhysicsModel, paths: Sequence[str], found: Innovations) -> FloatArray:
    """Gauss-Newton: -(J'J + prior)^-1 J' e."""
    slope = np.einsum("wip,wi->p", found.columns, found.white)
    curvature = np.einsum("wip,wiq->pq", found.columns, found.columns)
    return -np.asarray(regularized_inverse(curvature + _prior(model, paths)) @ slope)


def _prior(model: PhysicsModel, paths: Sequence[str]) -> FloatArray:
    """Curvature that says: within some ordinary changes of here, where the recordings say nothing."""
    return np.diag([(5.0 * typical_change(model.parameters[path])) ** -2 for path in paths])


def _shifted(model: PhysicsModel, paths: Sequence[str], shift: FloatArray) -> PhysicsModel:
    values = np.array([model.settings[path].value for path in paths]) + shift
    low, high = bounds_of(model, paths)
    return with_values(model, dict(zip(paths, np.clip(values, low, high).tolist(), strict=True)))


def _settled(before: PhysicsModel, after: PhysicsModel, paths: Sequence[str], found: Innovations) -> bool:
    change = np.array([after.settings[path].value - before.settings[path].value for path in paths])
    return bool((np.abs(change) < 0.1 * _deviations(after, paths, found)).all())


def _numerical(model: PhysicsModel, paths: Sequence[str]) -> FloatArray:
    """What integration and rounded corners leave open of each number's change from doing nothing, (paths,)."""
    neutral = [model.parameters[path].neutral for path in paths]
    values = [model.settings[path].value for path in paths]
    found = _NUMERICAL * np.abs([value - (at or 0.0) for value, at in zip(values, neutral, strict=True)])
    return np.asarray(np.hypot(found, [_border(model, path) for path in paths]))


def _border(model: PhysicsModel, path: str) -> float:
    """What the form of a border's rounded edge leaves open of where it is, 0 for every other number."""
    owner, name = path.split(".")
    item = next((own for own in model.effects if own.name == owner), None)
    if not isinstance(item, Conditioned) or not isinstance(item.law, Where):
        return 0.0
    own = {parameter.name for parameter in item.inner.parameters}
    return 0.0 if name in own else _BORDER * item.law.edge


def _runs_of(pieces: _Pieces, windows: Windows) -> IndexArray:
    """The run of each piece (pieces,); a stretch without a window counts as a run of its own."""
    known = dict(zip(windows.begin.tolist(), windows.run.tolist(), strict=True))
    stretch = np.searchsorted(windows.bounds[:, 1], pieces.rows[:, 0], side="right")
    begins = windows.bounds[stretch, 0].tolist()
    return np.array([known.get(begin, len(windows.names) + begin) for begin in begins], dtype=np.int64)


def _deviations(
    model: PhysicsModel, paths: Sequence[str], found: Innovations, runs: IndexArray | None = None
) -> FloatArray:
    """One standard deviation (paths,): the largest of the filter's own and of sandwiches over the pieces and the runs.

    Sandwich: C (sum over the groups of s s') C, C the filter's covariance, s (paths,) the score of a group, times
    R / (R - 1) for R runs. Pieces of one run may all be wrong to one side, which only runs show.
    """
    curvature = np.einsum("wip,wiq->pq", found.columns, found.columns)
    information = regularized_inverse(curvature + _prior(model, paths), 1e-12)
    scores = np.einsum("wip,wi->wp", found.columns, found.white)
    squares = [np.diag(information), np.diag(information @ (scores.T @ scores) @ information)]
    groups = np.unique(runs) if runs is not None else np.zeros(0)
    if len(groups) >= _FEWEST_RUNS:
        sums = np.stack([scores[runs == group].sum(axis=0) for group in groups])
        share = len(groups) / (len(groups) - 1.0)
        squares.append(share * np.diag(information @ (sums.T @ sums) @ information))
    return np.asarray(np.sqrt(np.maximum(np.max(squares, axis=0), 0.0)))
