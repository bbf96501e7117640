"""Finds channels whose clock drifts: they are recorded later and later than the model and the other channels say.

A drift looks like a delay, which grows with the time. To first order, the residual of a window at the time tau is

    r = (s0 + s1 tau) dr/ds + nuisance,    nuisance = a + b tau + sum_j (c_j + d_j tau) answer_j

where dr/ds is the change of the residual if the channels are read a row later, and answer_j what the prediction owes to
the command j. Missing physics is the same throughout, or changes the size of an answer; only a drift has s1. It is
confirmed by predictions with the channels read at the drifting times, compared with a constant delay. Where the drive
differs between the beginning and the end of a log, missing physics looks like a drift as well. So s1 is fitted again,
together with what each effect of the library would change.

Source: Huber, Annals of Mathematical Statistics 35, 1964 (clipped residuals); Frisch and Waugh, Econometrica 1, 1933
(nuisance columns are projected out); Liang and Zeger, Biometrika 73, 1986 (standard errors from blocks).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.comparison.rollout import rollout_at
from safedpa.comparison.windows import Windows, windows_of
from safedpa.diagnosis.fit.trial import initial_values, with_effect_at
from safedpa.dynamics import PhysicsModel
from safedpa.effects import effects_of
from safedpa.records.run import Finding, Run
from safedpa.systems import System

__all__ = ["clock_drifts"]

# Windows overlap by half, so that the time of a change is seen within a window; more add little.
_OVERLAP, _TESTED_WINDOWS = 0.5, 500
_LEAST_WINDOWS = 20
# Rows by which channels are moved for the derivative: above the noise of a row, below the time of a manoeuvre.
_READ_LATER = 3
# Windows of a block, which overlap: blocks are independent.
_BLOCK_OF_WINDOWS = 4
# Standard errors, rows, and the falls of the log of the squares that a drift needs: of one state, and of all together.
# Good logs had at most 7.6 standard errors, and those no such fall; logs with a drift at least 10, and 0.9 of all.
_SURE_OF_DRIFT, _DRIFTING_ROWS, _FALL_OF_ONE, _FALL_OF_ALL = 8.0, 2.0, 0.3, 0.4
# Sizes at which each effect is tried next to a drift, the standard errors that the drift needs then, and the share of
# the variance below which a column is a sum of others.
_SIZES_OF_EFFECT, _SURE_NEXT_TO_EFFECTS, _DEPENDENT = 2, 5.0, 1e-6
# Residuals per size below which effects are not fitted next to a drift.
_EQUATIONS = 1.5
# Lengths of a window, beyond which a drift is no small change of the times.
_LONGEST_DRIFT = 2.0
# Deviations beyond which a residual counts no more.
_HUBER, _CLIP = 4.0, 9.0


@dataclass(frozen=True)
class _Channels:
    """Channels of one clock: indices of states, or of actions."""

    names: tuple[str, ...]
    states: tuple[int, ...] = ()
    actions: tuple[int, ...] = ()


@dataclass(frozen=True)
class _DriftFit:
    """How many rows later some channels have to be read: at the middle, and at the end than at the beginning."""

    channels: _Channels
    constant: float
    drift: float
    standard_errors: float


def clock_drifts(model: PhysicsModel, run: Run, seconds: float) -> list[Finding]:
    """Returns a finding for the channels of a run whose drift explains most, if any; windows last ``seconds``."""
    every = windows_of([run], seconds, every=_OVERLAP * seconds)
    windows = every.select(np.unique(np.linspace(0, len(every) - 1, _TESTED_WINDOWS).astype(np.int64)))
    if len(windows) < _LEAST_WINDOWS:
        return []
    # Predictions may overflow where the model is unstable; those windows are left out.
    with np.errstate(all="ignore"):
        residual, answers = _residual_of(model, windows), _answers(model, windows)
        found = []
        for channels in _channels_of(model.system):
            fitted = _fitted_drift(model, windows, channels, residual, answers)
            linear = _DRIFTING_ROWS < abs(fitted.drift) < _LONGEST_DRIFT * float(np.median(windows.steps))
            if linear and abs(fitted.standard_errors) > _SURE_OF_DRIFT:
                fall = _fall_by_drift(model, windows, fitted)
                if fall.max() > _FALL_OF_ONE and fall.sum() > _FALL_OF_ALL:
                    found.append((float(fall.sum()), fitted))
        if not found:
            return []
        fitted = max(found, key=lambda item: item[0])[1]
        effects = _effects_of_library(model, windows, residual)
        if effects.shape[-1] * _EQUATIONS > residual.size:
            effects = effects[..., :0]  # so many sizes would fit anything, and leave no error to compare with
        again = _fitted_drift(model, windows, fitted.channels, residual, answers, effects)
    return [_finding_of(fitted, run)] if _agrees(again, fitted) else []


def _agrees(one: _DriftFit, other: _DriftFit) -> bool:
    return one.drift * other.drift > 0.0 and abs(one.standard_errors) > _SURE_NEXT_TO_EFFECTS


def _effects_of_library(model: PhysicsModel, windows: Windows, residual: FloatArray) -> FloatArray:
    """Returns what each effect that the model lacks would change of the residual, (windows, states, columns)."""
    have, actions, found = {item.name for item in model.effects}, set(model.system.action_names), []
    for item in effects_of(model.system.name).values():
        if item.name in have or not set(item.needs) <= actions:
            continue
        fitted_at_period = item.at_period(model.period)
        starts = initial_values(fitted_at_period)
        for index in np.unique(np.linspace(0, len(starts) - 1, _SIZES_OF_EFFECT).astype(np.int64)):
            found.append(_residual_of(with_effect_at(model, fitted_at_period, starts[index]), windows) - residual)
    columns = np.stack(found, axis=-1) if found else np.zeros((*residual.shape, 0))
    # An effect that diverges somewhere is left out, so that its windows remain.
    return np.asarray(columns[..., np.isfinite(columns[np.isfinite(residual).all(axis=1)]).all(axis=(0, 1))])


def _channels_of(system: System) -> Iterator[_Channels]:
    """Yields all actions, all states that are no rates, and each state and action by itself."""
    actions, states = system.action_names, system.state_names
    positions = tuple(at for at, item in enumerate(system.state) if not item.unit.endswith("/s"))
    if actions:
        yield _Channels(actions, (), tuple(range(len(actions))))
    if 0 < len(positions) < len(states):
        yield _Channels(tuple(states[at] for at in positions), positions)
    if len(states) > 1:
        yield from (_Channels((name,), (at,)) for at, name in enumerate(states) if (at,) != positions)
    if len(actions) > 1:
        yield from (_Channels((name,), (), (at,)) for at, name in enumerate(actions))


def _residual_of(model: PhysicsModel, windows: Windows) -> FloatArray:
    predicted = rollout_at(model, windows, [windows.end])[0]
    return np.asarray(model.system.difference(windows.states[windows.end], predicted))


def _answers(model: PhysicsModel, windows: Windows) -> FloatArray:
    """Returns what a prediction changes when each command replaces its mean, (windows, states, actions)."""
    given, found = rollout_at(model, windows, [windows.end])[0], []
    for index in range(windows.actions.shape[1]):
        actions = windows.actions.copy()
        actions[:, index] = actions[:, index].mean()
        without = rollout_at(model, replace(windows, actions=actions, memo={}), [windows.end])[0]
        found.append(model.system.difference(given, without))
    return np.stack(found, axis=-1) if found else np.zeros((*given.shape, 0))


def _read_later(windows: Windows, channels: _Channels, rows: FloatArray | float) -> Windows:
    """Returns windows whose channels are read so many rows later, within their stretches."""
    count = len(windows.t)
    stretch = np.searchsorted(windows.bounds[:, 1], np.arange(count), side="right")
    at = np.clip(np.arange(count) + rows, windows.bounds[stretch, 0], windows.bounds[stretch, 1] - 1)
    states, actions = windows.states.copy(), windows.actions.copy()
    for index in channels.states:
        states[:, index] = np.interp(at, np.arange(count), windows.states[:, index])
    for index in channels.actions:
        actions[:, index] = windows.actions[np.round(at).astype(np.intp), index]
    return replace(windows, states=states, actions=actions, memo={})


def _along(windows: Windows, rows: FloatArray) -> FloatArray:
    """Returns times from -0.5 at the first window to 0.5 at the last."""
    first, last = windows.time[windows.start[[0, -1]]]
    return np.asarray((rows - first) / (last - first) - 0.5)


def _fitted_drift(
    model: PhysicsModel,
    windows: Windows,
    channels: _Channels,
    residual: FloatArray,
    answers: FloatArray,
    effects: FloatArray | None = None,
) -> _DriftFit:
    """Fits s0, s1 and the sizes of effects to the residuals of all states; each state has nuisances of its own."""
    effects = np.zeros((*residual.shape, 0)) if effects is None else effects
    later, earlier = (_residual_of(model, _read_later(windows, channels, sign * _READ_LATER)) for sign in (1.0, -1.0))
    slope, tau = (earlier - later) / (2.0 * _READ_LATER), _along(windows, windows.time[windows.start])
    good = (np.isfinite(residual) & np.isfinite(slope) & np.isfinite(answers).all(axis=-1)).all(axis=1)
    good &= np.isfinite(effects).all(axis=(1, 2))
    count = 2 + effects.shape[-1]
    gram, moment, equations = np.zeros((count, count)), np.zeros(count), []
    for state in range(residual.shape[1]) if good.sum() >= _LEAST_WINDOWS else ():
        own, values = answers[good, state], residual[good, state]
        if np.var(slope[good, state]) <= 1e-16 * max(1.0, float(np.var(values))):
            continue
        common = np.column_stack([np.ones(len(own)), tau[good], own, own * tau[good, None]])
        common /= np.maximum(np.sqrt((common**2).mean(axis=0)), 1e-12)
        drifts = [slope[good, state], slope[good, state] * tau[good]]
        columns = np.column_stack([values, *drifts, effects[good, state]])
        columns = columns - common @ np.linalg.lstsq(common, columns, rcond=1e-8)[0]
        wanted, known = columns[:, 0], columns[:, 1:]
        rest = np.abs(wanted - known @ np.linalg.lstsq(known, wanted, rcond=1e-8)[0])
        scale = 1.4826 * float(np.median(rest)) + 1e-9 * float(np.std(values)) + 1e-300
        weight = np.minimum(1.0, _HUBER * scale / np.maximum(rest, 1e-300))[:, None] / scale**2
        gram, moment = gram + (weight * known).T @ known, moment + (weight * known).T @ wanted
        equations.append((wanted, known, weight))
    if not equations:
        return _DriftFit(channels, 0.0, 0.0, 0.0)
    inverse = _inverse_of(gram)
    solved = inverse @ moment
    scores = sum(weight * known * (wanted - known @ solved)[:, None] for wanted, known, weight in equations)
    blocks = np.add.reduceat(scores, np.arange(0, len(scores), _BLOCK_OF_WINDOWS), axis=0)
    error = float(np.sqrt((inverse @ blocks.T @ blocks @ inverse)[1, 1]))
    return _DriftFit(channels, float(solved[0]), float(solved[1]), float(solved[1]) / max(error, 1e-300))


def _inverse_of(gram: FloatArray) -> FloatArray:
    """Returns the pseudo-inverse of a matrix of products whose columns have different units."""
    size = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    scale = np.outer(size, size)
    return np.asarray(np.linalg.pinv(gram / scale, rcond=_DEPENDENT, hermitian=True) / scale)


def _fall_by_drift(model: PhysicsModel, windows: Windows, fitted: _DriftFit) -> FloatArray:
    """Returns by how much the log of the squares of each state falls if the constant delay becomes a drifting one."""
    along = np.clip(_along(windows, windows.time), -0.5, 0.5)
    constant, drifting = (
        _residual_of(model, _read_later(windows, fitted.channels, fitted.constant + part * fitted.drift * along)) ** 2
        for part in (0.0, 1.0)
    )
    good = np.isfinite(constant).all(axis=1) & np.isfinite(drifting).all(axis=1)
    sums = [
        np.minimum(squares, _CLIP * np.median(squares, axis=0)).sum(axis=0) + 1e-300
        for squares in (constant[good], drifting[good])
    ]
    return np.asarray(np.log(sums[0] / sums[1]))


def _finding_of(fitted: _DriftFit, run: Run) -> Finding:
    names, seconds = fitted.channels.names, abs(fitted.drift) * run.period
    text = (
        f"the clock of {' and '.join(names)} drifts: at the end {'they come' if len(names) > 1 else 'it comes'} "
        f"{seconds:.3g} s {'later' if fitted.drift > 0.0 else 'earlier'} than at the beginning, compared with the "
        f"prediction of the model ({abs(fitted.standard_errors):.0f} standard errors); nothing was cut; correct the "
        'column\'s times, or set keep = ["clock_drift"] in a column map if the robot itself changed'
    )
    return Finding("clock_drift", text, sum(len(part) for part in run.stretches), float(run.t[run.stretches[0].start]))
