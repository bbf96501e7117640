"""Adequacy: whether what a model leaves of unseen data is noise and disturbance, or depends on what was driven.

Measurement noise and a disturbance from outside do not depend on state, action, time or history. So five regressions
are tried on unseen folds:

- of the missing rates on powers, products and piecewise linear functions of every state and action, on past actions,
  and on the time, all together, with a ridge penalty;
- of the missing rates on each action times a low-pass of its size: an actuator that weakens as it heats up, or a clutch
  that slips, depends on all that was commanded before;
- of the missing rates on each action through a weakly damped oscillator: what rings, such as a flexible joint or a
  liquid, remembers commands for longer than any window;
- of each missing rate on the model's rate times a piecewise linear function of the size of the state: a gain that
  differs within a band of speeds;
- of the size of the residual of each window on the sizes of the states and actions in it: what grows with the command
  is no disturbance from outside, even if its mean is 0.

The first of them is also judged state by state, next to functions of one variable (``state_shares``).

Commands may change at any time between two rows. What that makes of the residual grows with the command as well, so
its expected squares are subtracted before sizes are compared.

Source: Hoerl and Kennard, Technometrics 12, 1970 (ridge regression); Billings and Voon, International Journal of
Control 44, 1986 (tests of residuals against all functions of past inputs and outputs); Breusch and Pagan, Econometrica
47, 1979 (variance that depends on regressors).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.comparison.actuators import lag_output
from safedpa.comparison.rollout import effective_actions
from safedpa.comparison.where import POSITION
from safedpa.diagnosis.fit.cross_validation import HeldoutError
from safedpa.diagnosis.fit.least_squares import fit
from safedpa.diagnosis.fit.multiple_shooting import Shooting, measurement_noise
from safedpa.diagnosis.fit.trial import EffectTrial, standardized_gain, trial_of
from safedpa.diagnosis.report_schema import Remainder
from safedpa.diagnosis.residuals.state_shares import PENALTIES, RidgeRegression, largest_state_share
from safedpa.diagnosis.residuals.weak_sindy import (
    FEW,
    PastAction,
    Regression,
    RowTerm,
    is_significant,
    regression_of,
    terms_of,
    usual_sizes,
)
from safedpa.diagnosis.search.regions import clip_outliers, residual_inputs
from safedpa.operations import NUMPY

# Share of the squares, and standard errors, from which the residual depends on what was driven. Where nothing is
# missing, the share was at most 0.01 with three or more standard errors. And the error that the dependence makes, in
# units of the usual change: what is smaller matters to no prediction.
_SHARE, _SURE, _SIZE = 0.05, 2.5, 0.01
# The part of the first error that this error has to exceed where effects were found: no model of a real robot is exact,
# and the effects that explain most of the error are not overruled by the rest.
_PART = 0.08
# Standard errors from which a smaller share suffices: one state of many may be all that it shows in.
_CLEAR, _SHARE_CLEAR = 4.0, 0.02
# Held-out error above which such a rest has to be most of the squares.
_REAL, _SHARE_REAL = 0.25, 0.5
# Ratio of mean squares, standard errors and held-out error from which the residual's size depends on what was driven.
# It does not count where effects were found: a real robot is predicted better at rest than in motion.
_RATIO, _SURE_RATIO, _ERROR_RATIO = 2.0, 4.5, 0.02
# Held-out error, in units of the usual change, above which a rest that is not measurement noise is no disturbance: the
# hardest recordings in which nothing is missing have 0.11. And the share of noise that excuses it.
_LARGE, _MOSTLY_NOISE = 0.15, 0.3
# The same of one state, with effects or without, and the correlation of its residual from one compared row to the next:
# noise that the sensor has filtered, as the velocities of falling balls, has at most 0.65 and is no missing effect.
# After all effects of four logs were found, a real car had at most 0.15. A robot of one state has nothing to compare
# with, and what no library explains of a real one may be larger (tanks: 0.32).
_LARGE_IN_STATE, _PERSISTENT = 0.17, 0.7
# The error of one state that what depends on the drive has to make, and its part of the first error where effects were
# found: of a fast servo with nothing hidden, whose commands change between the rows, it was 0.012.
_SIZE_IN_STATE, _PART_IN_STATE = 0.02, 0.25
# Fewer windows leave no fold to fit hundreds of terms in.
_MIN_WINDOWS = 12
# Frequencies that are compared, up to half of one per window.
_FREQUENCIES = 160
# Columns of the regression above which products of two variables are left out: they would take seconds.
_MOST_COLUMNS = 200
# Ages of past actions, in lengths of a window.
_AGES = (0.1, 0.25, 0.5, 1.0, 2.0)
# Share of the squares from which the standard errors of all tests suffice for one that was chosen among dozens.
_MOST = 0.5
# Time constants of the memory of an actuator, from half a window to a quarter of the longest stretch, and the share of
# commands that are large ones.
_MEMORIES, _LARGE_SHARE = 6, 0.4
# Frequencies of an oscillator, from two periods in the longest stretch to eight rows in a period; its damping ratio.
_OSCILLATIONS, _DAMPING = 40, 0.05
# Share of the squares with which fewer standard errors suffice for it: 18 robots with nothing hidden had at most 2.5.
_SHARE_RINGING = 0.1
# Knots of the gain of a rate over the size of its state.
_BANDS = 8
# Windows in a third of all that are compared, and multiples of the median at which their squares are clipped.
_MIN_THIRD, _CLIPPED = 5, 20.0
# Variance of the time at which a command changes, in squares of the shift that was tried: it is anywhere within a
# period, T^2 / 12, where half a period was tried, T^2 / 4.
_ANY_TIME = 1.0 / 3.0


def remainder_of(trial: EffectTrial, shooting: Shooting, states: Sequence[str]) -> Remainder | None:
    """Returns what a fitted model leaves, whose rates of ``states`` may be incomplete; None for too few windows."""
    if len(shooting.windows) < _MIN_WINDOWS or len(np.unique(shooting.fold)) < 2:
        return None
    # Commands that change between two rows act half a period earlier on average, which is no effect of the robot. The
    # fit is repeated for that, and because the filter may have moved the parameters.
    tried = []
    for windows in (shooting, shooting.with_commands(between_rows=shooting.recorded is None)):
        fitted = fit(trial.fit.model, trial.fit.paths, windows, trial.fit.scale, steps=2)
        tried.append((trial_of(fitted, windows, (), None), windows))
    best, windows = min(tried, key=lambda item: item[0].fit.value)
    ridge = _on_everything(best, windows, states)
    found = [test(best, windows, states) for test in (_periodic, _weakening, _ringing, _gain_by_size)]
    share, errors = max(_dependence(ridge), *found, key=lambda item: item[0])
    spread, variable, spread_errors = _spread(best, windows, _squares_by_timing(best, windows))
    noise = _noise_by_state(best, windows)
    of_state = largest_state_share(best, windows, states, ridge)
    return Remainder(
        share, errors, spread, variable, spread_errors, _mean_noise_share(noise), of_state.state, of_state.share,
        of_state.standard_errors, tuple(noise.tolist()), _persistence(best, windows),
    )  # fmt: skip


def _on_everything(trial: EffectTrial, shooting: Shooting, states: Sequence[str]) -> RidgeRegression:
    """Returns the regression of the missing rates on functions of everything measured."""
    every, past = terms_of(shooting.windows.system, usual_sizes(shooting)), _past_actions(shooting)
    if len(states) * (len(every) + len(past)) > _MOST_COLUMNS:
        every = [term for term in every if len(term.factors) < 2]
    return RidgeRegression(regression_of(trial, shooting, states, [*every, *past]))


def _dependence(ridge: RidgeRegression) -> tuple[float, float]:
    """Returns the share of unseen squares that a function of everything measured predicts, and its standard errors."""
    now = ridge.problem.unseen([])
    remaining = min(((ridge.unseen(penalty) ** 2).sum(axis=1) for penalty in PENALTIES), key=np.sum)
    return 1.0 - float(remaining.sum() / max(now.sum(), 1e-300)), ridge.problem.block_gain(now, remaining)


def _periodic(trial: EffectTrial, shooting: Shooting, states: Sequence[str]) -> tuple[float, float]:
    """Returns the same for a disturbance of one period, whose frequency and phase are fitted to the other folds."""
    windows = shooting.windows
    rates = clip_outliers(residual_inputs(trial, shooting, states))
    times = windows.time[windows.start] + 0.5 * windows.horizon
    frequencies = np.linspace(2.0 / max(float(np.ptp(times)), 1e-9), 0.5 / windows.horizon, _FREQUENCIES)
    phases = 2.0 * np.pi * frequencies[:, None] * times
    waves = np.stack([np.ones_like(phases), np.cos(phases), np.sin(phases)], axis=-1)
    now, remaining = np.zeros(len(times)), np.zeros(len(times))
    for values in (rates / np.maximum(rates.std(axis=0), 1e-12)).T:
        for fold in np.unique(shooting.fold):
            held = shooting.fold == fold
            known, wanted = waves[:, ~held], values[~held]
            gram, right = known.swapaxes(1, 2) @ known, known.swapaxes(1, 2) @ wanted
            solved = np.linalg.pinv(gram, hermitian=True) @ right[..., None]
            best = int(np.argmax((right * solved[..., 0]).sum(axis=1)))
            now[held] += (values[held] - wanted.mean()) ** 2
            remaining[held] += (values[held] - waves[best][held] @ solved[best, :, 0]) ** 2
    return 1.0 - float(remaining.sum() / max(now.sum(), 1e-300)), standardized_gain(now - remaining, shooting)


def _weakening(trial: EffectTrial, shooting: Shooting, states: Sequence[str]) -> tuple[float, float]:
    """Returns the same for an action times a low-pass of its size; 0 if that is not significant.

    The best of some dozen terms is taken, so it needs as many standard errors as a term of a formula.
    """
    terms = _weakening_terms(trial, shooting)
    if not terms:
        return 0.0, 0.0
    problem = regression_of(trial, shooting, states, terms)
    return _best_of(problem, [[index] for index in range(len(states) * len(terms))])


def _ringing(trial: EffectTrial, shooting: Shooting, states: Sequence[str]) -> tuple[float, float]:
    """Returns the same for an action through an oscillator, d2z/dt2 + 2 d w dz/dt + w^2 z = action, and its phase."""
    windows = shooting.windows
    longest = max(float(windows.clock[end - 1] - windows.clock[begin]) for begin, end in windows.bounds)
    first, last = 4.0 * np.pi / max(longest, 1e-9), 0.25 * np.pi / float(np.median(windows.period))
    pairs = [[2 * index, 2 * index + 1] for index in range(_OSCILLATIONS)]
    found = [(0.0, 0.0)]
    for name, action in zip(windows.system.action_names, effective_actions(trial.fit.model, windows).T, strict=True):
        terms = []
        for frequency in np.geomspace(first, last, _OSCILLATIONS):
            decays = np.exp((1.0j - _DAMPING) * frequency * windows.period)
            phase = lag_output(action.astype(complex), decays, windows, from_zero=True)
            terms += [RowTerm(f"{name} at {frequency:.3g} rad/s", part.copy()) for part in (phase.real, phase.imag)]
        found += [_best_of(regression_of(trial, shooting, [state], terms), pairs, ringing=True) for state in states]
    return max(found)


def _gain_by_size(trial: EffectTrial, shooting: Shooting, states: Sequence[str]) -> tuple[float, float]:
    """Returns the same for a rate that the model has, times a piecewise linear function of the size of its state."""
    windows, model = shooting.windows, trial.fit.model
    named = dict(zip(windows.system.state_names, windows.states.T, strict=True))
    action = dict(zip(windows.system.action_names, effective_actions(model, windows).T, strict=True))
    values = {item.name: model.settings[f"base.{item.name}"].value for item in model.base.parameters}
    rates = model.base.rates(named, action, values, NUMPY)
    found = [(0.0, 0.0)]
    for state in states:
        size = np.abs(named[state])
        knots = np.unique(np.quantile(size, np.linspace(0.02, 0.98, _BANDS)))
        rate = np.broadcast_to(rates[state], size.shape)
        bands = [rate * np.interp(size, knots, weights) for weights in np.eye(len(knots))]
        terms = [RowTerm(f"{state} {index}", values) for index, values in enumerate([rate, *bands])]
        problem = regression_of(trial, shooting, [state], terms)
        # Compared with a constant gain: noise of the state and the time of commands look like one.
        found.append(_best_of(problem, [[*range(1, 1 + len(bands))]], problem.unseen([0])))
    return max(found)


def _best_of(
    problem: Regression, groups: Sequence[Sequence[int]], now: FloatArray | None = None, *, ringing: bool = False
) -> tuple[float, float]:
    """Returns share and standard errors of the group of columns that predicts unseen squares best, if significant.

    ``now`` (windows,) are the squares without it; None: those of the free parameters alone.
    """
    now = problem.unseen([]) if now is None else now
    remaining = min((problem.unseen(group) for group in groups), key=lambda squares: float(squares.sum()))
    share, errors = 1.0 - float(remaining.sum() / max(now.sum(), 1e-300)), problem.block_gain(now, remaining)
    # What only a cold start shows is in few windows, which makes the standard error large.
    sure = is_significant(errors, share) or (share > _MOST and errors > _SURE)
    # Neighbouring frequencies are nearly the same column, so fewer are compared than there are.
    sure = sure or (ringing and errors > (FEW if share > _SHARE_RINGING else _CLEAR))
    return (share, errors) if sure else (0.0, 0.0)


def _weakening_terms(trial: EffectTrial, shooting: Shooting) -> list[RowTerm]:
    windows = shooting.windows
    longest = max(float(windows.clock[end - 1] - windows.clock[begin]) for begin, end in windows.bounds)
    first, last = 0.5 * windows.horizon, max(0.25 * longest, windows.horizon)
    found = []
    for name, action in zip(windows.system.action_names, effective_actions(trial.fit.model, windows).T, strict=True):
        size = np.abs(action) / max(float(np.sqrt(np.mean(action**2))), 1e-300)
        for seconds in np.geomspace(first, last, _MEMORIES):
            decays = np.exp(-windows.period / seconds)
            for what, used in (
                ("size", size),
                ("square", size**2),
                ("large", (size > np.quantile(size, 1.0 - _LARGE_SHARE)).astype(float)),
            ):
                for cold in (True, False):
                    past = lag_output(used, decays, windows, from_zero=cold)
                    text = f"{name} times its past {what} over {seconds:.3g} s{' from 0' if cold else ''}"
                    found.append(RowTerm(text, action * (past - past.mean())))
    return found


def with_sentence(found: Remainder, error: HeldoutError, first: float | None, states: Sequence[str]) -> Remainder:
    """Returns the remainder with its sentence if noise and a disturbance from outside do not explain it.

    ``error`` is the held-out error in units of the usual change, of ``states``; ``first`` that without the effects that
    were found, None if none was found.
    """
    if _depends_on_drive(found, error.value, first):
        text = (
            f"{found.share:.0%} of what remains of unseen data depends on states, actions, their past or the time"
            f" ({found.standard_errors:.1f} standard errors)"
        )
    elif first is None and found.spread > _RATIO and found.spread_errors > _SURE_RATIO and error.value > _ERROR_RATIO:
        text = (
            f"the mean square of what remains of unseen data differs by a factor of {found.spread:.1f} between small "
            f"and large {found.spread_of}, so it is no disturbance from outside"
        )
    elif first is None and error.value > _LARGE and found.noise_share < _MOSTLY_NOISE:
        text = (
            f"an error of {error.value:.2g} of the usual change remains; measurement noise explains "
            f"{found.noise_share:.0%} of it, and it is too large for a disturbance"
        )
    else:
        text = _sentence_of_state(found, error, first, states)
    return replace(found, sentence=text)


def _depends_on_drive(found: Remainder, error: float, first: float | None) -> bool:
    """Returns whether a share of all squares that matters depends on what was driven; see ``with_sentence``."""
    share = _SHARE_CLEAR if found.standard_errors > _CLEAR else _SHARE
    share = _SHARE_REAL if first is not None and error > _REAL else share
    size = _SIZE if first is None else max(_SIZE, _PART * first)
    return found.share > share and found.standard_errors > _SURE and structural_error(found, error) > size


def _sentence_of_state(found: Remainder, error: HeldoutError, first: float | None, states: Sequence[str]) -> str:
    """Returns the sentence about one state that is predicted worse than the others; empty if there is none."""
    if found.state:
        own = float(error.per_state[list(states).index(found.state)] * np.sqrt(found.state_share))
        if own > max(_SIZE_IN_STATE, _PART_IN_STATE * (first or 0.0)):
            return (
                f"{found.state_share:.0%} of what remains of {found.state} of unseen data depends on states, actions "
                f"or their past ({found.state_errors:.1f} standard errors)"
            )
    is_motion = np.array(found.persistence_by_state) > _PERSISTENT
    is_no_noise = np.array(found.noise_by_state) < _MOSTLY_NOISE
    rest = np.nan_to_num(np.where(is_motion & is_no_noise, error.per_state, 0.0), posinf=np.inf)  # NaN: no change
    worst = int(np.argmax(rest))
    if len(rest) > 1 and rest[worst] > _LARGE_IN_STATE:
        return (
            f"an error of {rest[worst]:.2g} of the usual change of {states[worst]} remains; measurement noise explains "
            f"{found.noise_by_state[worst]:.0%} of it, and it is too large for a disturbance"
        )
    return ""


def structural_error(found: Remainder, error: float) -> float:
    """Returns the part of a held-out error that depends on what was driven, in units of the usual change."""
    return error * float(np.sqrt(max(found.share, 0.0)))


def _past_actions(shooting: Shooting) -> list[PastAction]:
    steps = float(np.median(shooting.windows.steps))
    rows = sorted({max(1, round(age * steps)) for age in _AGES})
    return [PastAction(name, count) for name in shooting.windows.system.action_names for count in rows]


def _squares_by_timing(trial: EffectTrial, shooting: Shooting) -> FloatArray:
    """Returns the expected squares (windows, states) of the residual from commands that change at any time."""
    if not trial.fit.model.system.action:
        return np.zeros_like(trial.heldout)
    other = shooting.with_commands(between_rows=shooting.recorded is None)
    now, moved = (windows.residuals([trial.fit.model])[0] for windows in (shooting, other))
    shift = shooting.eliminated((moved - now)[..., None], trial.fit.scale)[..., 0]
    return _ANY_TIME * shooting.squares(shift) * trial.fit.scale**2


def _spread(trial: EffectTrial, shooting: Shooting, timing: FloatArray) -> tuple[float, str, float]:
    """Returns ratio, variable and standard errors of the largest dependence of the residual's size; see Remainder.

    ``timing`` (windows, states) are squares that the time of the commands explains.
    """
    squares = (np.maximum(trial.heldout - timing, 0.0) / trial.fit.scale**2).sum(axis=1)
    # A few disturbed windows must not decide.
    squares = np.minimum(squares, _CLIPPED * np.median(squares) + 1e-12)
    found = [(1.0, "", 0.0)]
    for name, values in _sizes_in_windows(shooting).items():
        low, high = np.quantile(values, [1.0 / 3.0, 2.0 / 3.0])
        small, large = squares[values <= low], squares[values >= high]
        if not high > low or min(len(small), len(large)) < _MIN_THIRD:
            continue
        error = np.sqrt(small.var(ddof=1) / len(small) + large.var(ddof=1) / len(large))
        difference = float(large.mean() - small.mean())
        ratio = float(max(large.mean(), small.mean()) / max(min(large.mean(), small.mean()), 1e-12))
        found.append((ratio, name, abs(difference) / max(float(error), 1e-12)))
    return max(found, key=lambda item: item[2])


def _sizes_in_windows(shooting: Shooting) -> dict[str, FloatArray]:
    """Returns the mean size of each state and action in each window, by name."""
    windows = shooting.windows
    rows = np.minimum(windows.start[:, None] + shooting.rows, windows.end[:, None] - 1)
    states, actions = windows.states[rows], windows.actions[rows]
    found = {}
    for index, variable in enumerate(windows.system.state):
        if variable.name not in POSITION and not variable.angle:
            found[variable.name] = np.abs(states[..., index]).mean(axis=1)
    for index, variable in enumerate(windows.system.action):
        found[variable.name] = np.abs(actions[..., index]).mean(axis=1)
    return found


def _noise_by_state(trial: EffectTrial, shooting: Shooting) -> FloatArray:
    """Returns the share of each state's squares that measurement noise explains, (states,); NaN if unknown."""
    return np.minimum(1.0, (measurement_noise(shooting.windows) / np.maximum(trial.fit.scale, 1e-12)) ** 2)


def _persistence(trial: EffectTrial, shooting: Shooting) -> tuple[float, ...]:
    """Returns the correlation of each state's residual from one compared row to the next."""
    residual = shooting.residuals([trial.fit.model])[0] * (shooting.counts > 0.0)
    squares = np.maximum((residual**2).sum(axis=(0, 1)), 1e-300)
    return tuple(((residual[:, 1:] * residual[:, :-1]).sum(axis=(0, 1)) / squares).tolist())


def _mean_noise_share(by_state: FloatArray) -> float:
    return float(np.mean(by_state[np.isfinite(by_state)])) if np.isfinite(by_state).any() else 0.0
