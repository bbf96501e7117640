"""Trials: one or more effects added to a model, fitted from a grid of starts, with their gain on unseen data."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.diagnosis.fit.least_squares import Fit, bounds_of, fit, objectives
from safedpa.diagnosis.fit.multiple_shooting import Shooting
from safedpa.diagnosis.report_schema import FittedValue
from safedpa.dynamics import PhysicsModel
from safedpa.dynamics.settings import Setting
from safedpa.effects import AbstractEffect
from safedpa.effects.parameter import Parameter

# Starts of an effect with several parameters at most: the full grid would grow with the power of their number.
_MAX_STARTS = 9
# One Gauss-Newton step ranks the effects well enough to choose those that are fitted to the end.
_ROUGH_STEPS = 1
# Fewer blocks do not show their own spread: the gain is then 0, so nothing is accepted.
_MIN_BLOCKS = 8
# Effects that are fitted to the end at each stage: a rough fit does not always rank the best one first.
_FINAL_FITS = 8


@dataclass(frozen=True)
class EffectTrial:
    """Effects added together and fitted; ``heldout`` (windows, states) are squares predicted without the own fold."""

    effects: tuple[str, ...]
    fit: Fit
    heldout: FloatArray
    explained: FloatArray
    """Reduction of the residual by the effects, (windows, compared * states), in units of the stage's noise."""
    loss: float
    """sum over states of size log(held-out root mean square) / sum of sizes."""

    @property
    def name(self) -> str:
        """Name of the effect; pairs are joined with a plus sign."""
        return " + ".join(self.effects)


def initial_values(item: AbstractEffect) -> list[dict[str, float]]:
    """Returns values from which a fit of an effect starts; at the neutral value many effects have no gradient."""
    grids = [_grid(parameter, len(item.parameters)) for parameter in item.parameters]
    names = [parameter.name for parameter in item.parameters]
    every = [dict(zip(names, values, strict=True)) for values in product(*grids)]
    spread = (
        np.unique(np.linspace(0, len(every) - 1, _MAX_STARTS).astype(int)) if len(every) > 16 else range(len(every))
    )
    return [every[index] for index in spread]


def _grid(parameter: Parameter, alongside: int) -> list[float]:
    """Returns fractions and multiples of the typical value, on both sides if the bounds allow it."""
    neutral, typical = parameter.neutral, parameter.typical
    if typical == 0.0 and not neutral:
        found = [part * parameter.high for part in (-0.4, -0.15, 0.0, 0.15, 0.4)]
    elif neutral is None:
        found = [0.4 * typical, typical, 2.5 * typical]
    elif neutral == 0.0:
        parts: tuple[float, ...] = (0.15, 0.4, 0.8, 1.2, 1.8, 3.0) if alongside == 1 else (0.4, 1.5)
        found = [part * typical for part in parts] if typical else [0.0]
        if parameter.low < 0.0:
            found = [sign * value for value in found[: 3 if alongside == 1 else 1] for sign in (-1.0, 1.0)]
    elif neutral / typical >= 3.0:
        # A limit that is far away does nothing and has no gradient: a grid over two decades finds where it acts.
        parts = (0.1, 0.3, 0.6, 1.0, 1.6, 2.5, 6.0) if alongside == 1 else (0.3, 0.8, 1.2, 2.2)
        found = [part * typical for part in parts]
    elif abs(neutral - typical) < 0.5 * neutral:
        found = [neutral + part * (typical - neutral) for part in (-2.0, -1.0, -0.3, 0.3, 1.0, 2.0)]
    else:
        found = [part * typical for part in (0.4, 0.6, 0.75, 0.9, 1.0, 1.1, 1.3)]
    return [value for value in found if parameter.low <= value <= parameter.high]


def with_effect_at(model: PhysicsModel, item: AbstractEffect, values: dict[str, float]) -> PhysicsModel:
    """Returns the model with one more effect at the given parameter values."""
    return model.with_effect(item, {name: Setting(value) for name, value in values.items()})


def fit_trials(
    null: EffectTrial,
    items: Sequence[AbstractEffect],
    shooting: Shooting,
    before: Mapping[str, EffectTrial],
    report_progress: Callable[[int], None] = lambda _done: None,
) -> list[EffectTrial]:
    """Fits every effect by itself, best first: all of them roughly, then the most promising ones to the end.

    ``before`` holds trials of an earlier stage by effect: their values are starts alongside a thinned grid.
    """
    found = []
    for number, item in enumerate(items):
        starts = start_models(null.fit.model, [item])
        if item.name in before and before[item.name].fit.free[-len(item.parameters) :].all():
            settings = before[item.name].fit.model.settings
            # Values at a bound are a poor start: the bound was active for want of the effect added since.
            known = {p.name: settings[f"{item.name}.{p.name}"].value for p in item.parameters}
            starts = [with_effect_at(null.fit.model, item, known), *starts[::3]]
        found.append(fit_trial(null, [item], shooting, starts, _ROUGH_STEPS))
        report_progress(number)
    found.sort(key=lambda trial: trial.loss)
    by_name = {item.name: item for item in items}
    for index, rough in enumerate(found[:_FINAL_FITS]):
        found[index] = fit_trial(null, [by_name[rough.effects[0]]], shooting, [rough.fit.model])
    return sorted(found, key=lambda trial: trial.loss)


def fit_trial(
    null: EffectTrial,
    items: Sequence[AbstractEffect],
    shooting: Shooting,
    starts: Sequence[PhysicsModel] | None = None,
    steps: int | None = None,
) -> EffectTrial:
    """Fits the effects on top of the null model, together with all parameters that the null fitted."""
    models = list(starts) if starts is not None else start_models(null.fit.model, items)
    chosen = best_start(models, shooting, null.fit.scale)
    # All parameters are refitted: those of the null have compensated for the missing effect.
    paths = [*null.fit.paths, *(f"{item.name}.{p.name}" for item in items for p in item.parameters)]
    rough = () if steps is None else (steps, null.fit.slopes)
    found = fit(chosen, paths, shooting, null.fit.scale, *rough)
    return trial_of(found, shooting, tuple(item.name for item in items), null)


def best_start(models: Sequence[PhysicsModel], shooting: Shooting, scale: FloatArray) -> PhysicsModel:
    """Returns the model with the lowest objective: simulating all starts is far cheaper than fitting from each."""
    if len(models) == 1:
        return models[0]
    return models[int(np.argmin(objectives(shooting.residuals(models), shooting, scale)))]


def trial_of(found: Fit, shooting: Shooting, effects: tuple[str, ...], null: EffectTrial | None) -> EffectTrial:
    """Returns a fit as a trial, with its held-out squares and what it explains compared with the null."""
    heldout = found.heldout_squares(shooting)
    # The logarithm weights states by relative improvement, whatever their units; the floor covers exact predictions.
    mean = np.maximum(heldout.sum(axis=0) / shooting.size, 1e-12)
    loss = float((shooting.size * np.log(mean)).sum() / (2.0 * shooting.size.sum()))
    explained = np.zeros_like(found.residual) if null is None else explained_by(found, null)
    return EffectTrial(effects, found, heldout, explained, loss)


def explained_by(found: Fit, null: EffectTrial) -> FloatArray:
    """Returns by how much a fit reduces the residual of another one (windows, compared * states), in its noise."""
    # Both residuals in units of the null's noise: only then do they differ by what the effects explain.
    ratio = np.tile(found.scale / null.fit.scale, found.residual.shape[1] // len(found.scale))
    return np.asarray(null.fit.residual - found.residual * ratio)


def start_models(model: PhysicsModel, items: Sequence[AbstractEffect]) -> list[PhysicsModel]:
    """Returns the model with the effects at all values from which their fit may start."""
    grids = [initial_values(item) for item in items]
    if len(items) > 1:
        # About four starts per effect keep the product over a pair at sixteen or so.
        grids = [grid[:: max(1, len(grid) // 4)] for grid in grids]
    found = []
    for values in product(*grids):
        extended = model
        for item, start in zip(items, values, strict=True):
            extended = with_effect_at(extended, item, start)
        found.append(extended)
    return found


def block_gain(one: EffectTrial, other: EffectTrial, shooting: Shooting, *, local: bool = False) -> float:
    """Returns how much better ``other`` predicts unseen blocks than ``one``, in standard errors.

    The gain is the sum over the blocks of the difference of their squares (over the better trial's mean square),
    divided by its standard error. With n + 1 blocks that ratio t follows Student's distribution. The normal deviate of
    the same probability is returned, (8 n + 1) / (8 n + 3) sqrt(n log(1 + t^2 / n)) (Wallace, Annals of Mathematical
    Statistics 30, 1959); 0 for fewer than 8 blocks.

    The difference of a window counts at most 20 times the median one. With ``local``, for effects that act in some
    windows only, it may count as much as the 90 % quantile.
    """
    scale = np.maximum(np.minimum(one.heldout.sum(axis=0), other.heldout.sum(axis=0)) / shooting.size, 1e-12)
    return standardized_gain(((one.heldout - other.heldout) / scale).sum(axis=1), shooting, local=local)


def ratio_gain(one: EffectTrial, other: EffectTrial, shooting: Shooting) -> float:
    """Returns how much better ``other`` predicts unseen blocks than ``one``, from the ratios of their squares.

    The mean over the blocks of log(squares of one / squares of other), in its standard errors. While most of the
    physics is missing, a few blocks hold most squares, and differences of squares vary as much as they are large.
    Ratios do not: an effect that is really missing reduces the squares of every block by about the same share.
    """
    first = shooting.first_of_block
    if len(first) < _MIN_BLOCKS:
        return 0.0
    scale = np.maximum(np.minimum(one.heldout.sum(axis=0), other.heldout.sum(axis=0)) / shooting.size, 1e-12)
    squares = np.stack([(trial.heldout / scale).sum(axis=1)[shooting.by_block] for trial in (one, other)])
    # One unit of the noise keeps blocks with nothing to predict from deciding by the ratio of two roundings.
    sums = np.log(np.add.reduceat(squares, first, axis=1) + 1.0)
    return float(_normal_deviates((sums[0] - sums[1])[None], 1e-3)[0])


def standardized_gain(difference: FloatArray, shooting: Shooting, *, local: bool = False) -> float:
    """Returns the gain of differences (windows,) of squares in units of the noise, as in ``block_gain``."""
    return float(standardized_gains(difference[None], shooting, local=local)[0])


def standardized_gains(differences: FloatArray, shooting: Shooting, *, local: bool = False) -> FloatArray:
    """Returns the gains of many differences (many, windows) at once, (many,)."""
    first = shooting.first_of_block
    if len(first) < _MIN_BLOCKS:
        return np.zeros(len(differences))
    # Clipping before the sum: one disturbed window must not decide a whole test.
    sizes = np.abs(differences)
    most = 20.0 * np.median(sizes, axis=1, keepdims=True) + 1e-12
    if local:
        most = np.maximum(most, np.quantile(sizes, 0.9, axis=1, keepdims=True))
    sums = np.add.reduceat(np.clip(differences, -most, most)[:, shooting.by_block], first, axis=1)
    # The floor of one unit of the noise: a smaller gain is rounding, however steady it is from block to block.
    return _normal_deviates(sums, 1.0)


def _normal_deviates(sums: FloatArray, rounding: float) -> FloatArray:
    """Returns the normal deviates (many,) of the t ratios of block sums (many, blocks); see ``block_gain``."""
    count = sums.shape[1]
    spread = sums.std(axis=1, ddof=1) * np.sqrt(count)
    ratio, freedom = sums.sum(axis=1) / np.hypot(spread, rounding), count - 1
    normal = (8 * freedom + 1) / (8 * freedom + 3) * np.sqrt(freedom * np.log1p(ratio**2 / freedom))
    return np.asarray(np.copysign(normal, ratio))


def explanation_correlation(one: EffectTrial, other: EffectTrial) -> float:
    """Returns the correlation (-1 to 1) of what two trials of one stage explain."""
    size = float(np.sqrt((one.explained**2).sum() * (other.explained**2).sum()))
    return float((one.explained * other.explained).sum() / size) if size > 0 else 0.0


def has_shape_at_bound(trial: EffectTrial, shooting: Shooting) -> bool:
    """Returns whether a parameter that only shapes an effect of the trial is within one deviation of a bound.

    Such a parameter has no neutral value, so its deviation from one is never judged. Example: friction that fades at a
    rate below what the sensor resolves is a way to describe hands that hold a joint.
    """
    fitted = trial.fit
    shapes = [fitted.model.parameters[path].neutral is None for path in fitted.paths]
    own = np.array([path.split(".")[0] in trial.effects for path in fitted.paths]) & np.array(shapes, dtype=bool)
    if not own.any():
        return False
    low, high = bounds_of(fitted.model, fitted.paths)
    near = np.minimum(fitted.values - low, high - fitted.values) < np.nan_to_num(fitted.deviations(shooting))
    return bool((own & (near | ~fitted.free)).any())


def paths_of(items: Iterable[AbstractEffect]) -> list[str]:
    """Returns the paths of all parameters of effects."""
    return [f"{item.name}.{p.name}" for item in items for p in item.parameters]


def values_of(trial: EffectTrial, shooting: Shooting) -> dict[str, FittedValue]:
    """Returns the fitted parameters of a trial by path, with standard deviation and unit."""
    model, deviations = trial.fit.model, trial.fit.deviations(shooting)
    found = {}
    for path, value, std in zip(trial.fit.paths, trial.fit.values, deviations, strict=True):
        spread = float(std) if np.isfinite(std) else None
        found[path] = FittedValue(float(value), spread, model.parameters[path].unit)
    return found
