"""Fits parameters by nonlinear least squares on short rollouts, with their uncertainty and their held-out squares.

minimise sum over the states s of size_s log(sum of squares of the reduced residual of s)

This is the likelihood of Gaussian noise whose variance is unknown for each state and is estimated with the parameters.
The method is Gauss-Newton with bounds; derivatives are difference quotients.

Source: Seber and Wild, Nonlinear Regression, Wiley 1989, ch. 11; Efron and Tibshirani, An Introduction to the
Bootstrap, 1993, ch. 11 (jackknife).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray
from safedpa.diagnosis.fit.multiple_shooting import ProjectedProducts, Shooting
from safedpa.dynamics import PhysicsModel
from safedpa.dynamics.settings import Setting
from safedpa.effects.parameter import Parameter

# Gauss-Newton from a good start converges in a few steps; 8 bounds the fits that do not.
_STEPS = 8
# Decrease of the objective per degree of freedom below which a fit has converged: 0.02 % of the residual.
_CONVERGED = 2e-4
# A step that would decrease the objective by less than this share of _CONVERGED is not simulated again: the linear
# prediction is exact enough and saves a rollout per fit.
_NEGLIGIBLE = 0.1
# Steps with slopes taken from another fit, and the decrease below which they have converged. They need no rollouts for
# derivatives, so they sort out hopeless trials cheaply.
_WARM_STEPS, _WARM_CONVERGED = 3, 2e-3
# Decrease in the last of them from which a fit is not abandoned: it is still open where it would end.
_FALLING = 0.02
# Bound on the remaining decrease, in multiples of the last step's: steps that each shrink to 4/5 of the one before
# add up to 4 times the last one.
_REMAINING = 4.0


@dataclass(frozen=True)
class Fit:
    """A model with fitted parameters, its residual and the derivatives with respect to the parameters.

    ``residual`` (windows, compared * states) and ``columns`` (..., paths) are reduced (without what the starts explain)
    and in units of ``scale`` (states,). ``slopes`` (windows, compared, states, paths): the derivatives before that, in
    the states' units.
    """

    model: PhysicsModel
    paths: tuple[str, ...]
    value: float
    """The objective per degree of freedom."""
    scale: FloatArray
    residual: FloatArray
    columns: FloatArray
    slopes: FloatArray
    free: NDArray[np.bool_]
    """Whether each parameter is away from an active bound and affects the residual, (paths,)."""
    normal: tuple[FloatArray, FloatArray]
    """Products of the columns with each other (paths, paths) and with the residual (paths,), at the linearisation."""
    stated: FloatArray | None = None
    """Standard deviations (paths,) if another estimator replaced them."""

    @property
    def values(self) -> FloatArray:
        """The parameter values, (paths,)."""
        return np.array([self.model.settings[path].value for path in self.paths])

    @property
    def prior(self) -> FloatArray:
        """Curvature of a weak Gaussian prior (paths,), which keeps directions without data near their start."""
        return prior_curvature(self.model, self.paths)

    def deviations(self, shooting: Shooting) -> FloatArray:
        """Returns one standard deviation of each parameter (paths,), NaN where the data do not determine it.

        It is the largest of a jackknife over blocks of time, a jackknife over runs (if there are four or more), and the
        value for white residuals. The jackknife is

            (B - 1) / B sum over the blocks of (parameters without the block - parameters)^2, to first order.

        At a bound it is the distance into the allowed side over which the squares grow by one unit of the noise
        (profile likelihood).
        """
        if self.stated is not None:
            return self.stated
        found = self._at_bounds()
        if not self.free.any():
            return found
        columns = self.columns[..., self.free]
        products, slopes = products_of(columns, self.residual)
        whole = products.sum(axis=0)
        squares = np.diag(regularized_inverse(whole)) * (self.residual**2).sum() / max(shooting.size.sum(), 1.0)
        # Residuals are correlated in time and differ between runs, so white noise alone gives too small a deviation.
        for group in (shooting.block, shooting.windows.run):
            count = len(np.unique(group))
            if group is shooting.block or count >= _MIN_RUNS:
                squares = np.maximum(squares, jackknife(products, slopes, group))
        found[self.free] = np.sqrt(np.maximum(squares, 0.0))
        return found

    def _at_bounds(self) -> FloatArray:
        """Returns one-sided deviations of parameters at a bound (paths,), NaN if free: d with 2 |g| d + h d^2 = 1.

        g and h are slope and curvature of half the squares, in units of the noise.
        """
        flat = self.columns.reshape(self.residual.size, len(self.paths))
        slope, curvature = np.abs(flat.T @ self.residual.reshape(-1)), (flat**2).sum(axis=0)
        low, high = bounds_of(self.model, self.paths)
        with np.errstate(all="ignore"):
            distance = (np.sqrt(slope**2 + curvature) - slope) / curvature
        # A deviation as wide as the allowed range says no more than the bounds do.
        usable = ~self.free & np.isfinite(distance) & (distance > 0) & (distance < high - low)
        return np.where(usable, distance, np.nan)

    def without(self, shooting: Shooting) -> dict[int, FloatArray]:
        """Returns the parameters (paths,) fitted without each fold, to first order, by fold."""
        folds = np.unique(shooting.fold)
        values, free = np.tile(self.values, (len(folds), 1)), self.free
        if free.any() and len(folds) > 1:
            curvature, slope = products_of(self.columns[..., free], self.residual)
            used = [shooting.fold != fold for fold in folds]
            parts = np.stack([curvature[rows].sum(axis=0) for rows in used]) + np.diag(self.prior[free])
            slopes = np.stack([slope[rows].sum(axis=0) for rows in used])
            # One Newton step per fold from the common fit replaces a refit; held-out rollouts then judge the result.
            values[:, free] -= (regularized_inverse(parts, _SETTLED) @ slopes[..., None])[..., 0]
        return dict(zip(folds.tolist(), np.clip(values, *bounds_of(self.model, self.paths)), strict=True))

    def heldout_squares(self, shooting: Shooting) -> FloatArray:
        """Returns the squares (windows, states) of the reduced residual, predicted without the window's fold."""
        shift = np.zeros((len(shooting.windows), len(self.paths)))
        for fold, values in self.without(shooting).items():
            shift[shooting.fold == fold] = values - self.values
        residual = self.residual + (self.columns @ shift[..., None])[..., 0]
        return np.asarray(shooting.squares(residual) * self.scale**2)


def jackknife(products: FloatArray, slopes: FloatArray, group: NDArray[np.int64]) -> FloatArray:
    """Returns the variances (paths,) by a delete-one-group jackknife over ``group`` (windows,), to first order."""
    count, size = int(group.max()) + 1, products.shape[-1]
    curvature, slope = np.zeros((count, size, size)), np.zeros((count, size))
    np.add.at(curvature, group, products)
    np.add.at(slope, group, slopes)
    present = np.unique(group)
    whole, total = curvature.sum(axis=0), slope.sum(axis=0)
    shifts = (regularized_inverse(whole - curvature[present]) @ (total - slope[present])[..., None])[..., 0]
    share = (len(present) - 1) / max(len(present), 1)
    return np.asarray(((shifts - shifts.mean(axis=0)) ** 2).sum(axis=0) * share)


# With fewer runs the spread between them is itself too uncertain to replace that between blocks.
_MIN_RUNS = 4
# Share of the curvature below which a direction keeps the value of all folds: valleys of the objective are curved, and
# a straight step along one leaves it.
_SETTLED = 3e-3


def fit(
    model: PhysicsModel,
    paths: Sequence[str],
    shooting: Shooting,
    scale: FloatArray,
    steps: int = _STEPS,
    known: FloatArray | None = None,
    enough: float = np.inf,
) -> Fit:
    """Fits the parameters ``paths`` of a model from their present values; ``scale`` (states,) is a guess of the noise.

    ``known`` (windows, compared, states, some) are slopes of the first paths, which are not computed again; a rough fit
    saves half of its rollouts with them. With a bound ``enough`` of the objective, a fit takes its first steps with the
    known slopes. It continues with its own only if it is below the bound, or still falls fast and the bound is finite.
    Most trials of a search end early this way: slopes of parameters that hardly move change little.
    """
    names = tuple(paths)
    best = _linearised(model, names, shooting, scale, known)
    if known is not None and enough < np.inf:
        warm, decrease = _iterate(best, shooting, _WARM_STEPS, known, _WARM_CONVERGED)
        if warm.value > enough and (decrease < _FALLING or enough == -np.inf):
            return warm
        best = _linearised(warm.model, names, shooting, warm.scale, None)
        known = None
    return _iterate(best, shooting, steps, known, _CONVERGED, enough)[0]


def relinearized(fitted: Fit, shooting: Shooting) -> tuple[Fit, Shooting]:
    """Fits a model again in windows with the starts and weights of its own; returns the fit and these windows.

    The weights of the previous model treat a large missing effect as a disturbance by a person: a car that a load holds
    back while the model drives on. Such windows are down-weighted although they show the effect best.
    """
    # The windows first: the fit minimises residuals with the weights that these give.
    own = shooting.around(fitted.model)
    return fit(fitted.model, fitted.paths, own, fitted.scale), own


def _iterate(
    best: Fit, shooting: Shooting, steps: int, known: FloatArray | None, done: float, enough: float = np.inf
) -> tuple[Fit, float]:
    """Takes Gauss-Newton steps until the objective decreases by less than ``done``; returns fit and last decrease.

    A last step that is predicted to be negligible is not simulated: its result follows from the slopes. A fit that no
    longer falls fast and is farther above ``enough`` than _REMAINING times the last decrease is abandoned.
    """
    damping = decrease = 0.0
    for _ in range(steps):
        shift = _gauss_newton_step(best, damping)
        if shift is None:
            break
        # Only an undamped step shows that the fit has converged: a damped one is short for another reason.
        if damping == 0.0 and steps > 1:
            last = _linear_update(best, shift, shooting, _NEGLIGIBLE * done)
            if last is not None:
                return last, 0.0
        new = _linearised(shifted(best.model, best.paths, shift), best.paths, shooting, best.scale, known)
        if new.value < best.value:
            # Levenberg-Marquardt damping: raised tenfold after a failure until a step helps, relaxed tenfold after a
            # success because Gauss-Newton converges faster near the minimum.
            decrease, best, damping = best.value - new.value, new, 0.0 if damping < 0.1 else 0.1 * damping
            if decrease < done or (decrease < _FALLING and best.value - enough > _REMAINING * decrease):
                break
        else:
            damping = 0.05 if damping == 0.0 else 10.0 * damping
            # A step damped this much moves nothing: the slopes are wrong there, for example at a kink.
            if damping > 100.0:
                break
    return best, decrease


def _linear_update(at: Fit, shift: FloatArray, shooting: Shooting, done: float) -> Fit | None:
    """Returns the fit after a negligible step (paths,), from its slopes; None if not negligible or at a bound."""
    values = at.values + shift
    low, high = bounds_of(at.model, at.paths)
    if ((values <= low) | (values >= high))[at.free].any():
        return None
    residual = at.residual + at.columns @ shift
    decrease = 0.5 * float((at.residual**2).sum() - (residual**2).sum()) / float(shooting.size.sum())
    if not 0.0 <= decrease < done:
        return None
    return replace(at, model=shifted(at.model, at.paths, shift), value=at.value - decrease, residual=residual)


def prior_curvature(model: PhysicsModel, paths: Sequence[str]) -> FloatArray:
    """Returns the curvature of a weak Gaussian prior, (paths,)."""
    # Five typical changes: far too wide to affect a parameter that the data determine at all.
    return np.array([(5.0 * typical_change(model.parameters[path])) ** -2 for path in paths])


def shifted(model: PhysicsModel, paths: Sequence[str], shift: FloatArray) -> PhysicsModel:
    """Returns the model with parameters moved by ``shift`` (paths,), clipped to their bounds."""
    values = np.array([model.settings[path].value for path in paths]) + shift
    return with_values(model, dict(zip(paths, np.clip(values, *bounds_of(model, paths)).tolist(), strict=True)))


def known_slopes(fitted: Fit, paths: Sequence[str]) -> FloatArray:
    """Returns slopes of the leading ``paths`` that another fit has: the ``known`` argument of ``fit``."""
    index_of = {path: index for index, path in enumerate(fitted.paths)}
    count = next((index for index, path in enumerate(paths) if path not in index_of), len(paths))
    return np.asarray(fitted.slopes[..., [index_of[path] for path in paths[:count]]])


def objectives(residuals: FloatArray, shooting: Shooting, scale: FloatArray) -> FloatArray:
    """Returns the objective per degree of freedom (models,) of residuals (models, windows, compared, states)."""
    return _objectives(shooting.elimination.products(residuals), shooting, scale)[0]


def _objectives(products: ProjectedProducts, shooting: Shooting, scale: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Returns objectives per degree of freedom (models,) and each state's root mean square (states, models)."""
    squares = shooting.elimination.squares(products, scale)
    # The logarithm needs a positive value: a simulated recording can be predicted exactly.
    found = np.maximum(np.sqrt(squares / shooting.size[:, None]), 1e-6)
    return shooting.size @ np.log(found) / shooting.size.sum(), found


def _linearised(
    model: PhysicsModel, paths: tuple[str, ...], shooting: Shooting, scale: FloatArray, known: FloatArray | None
) -> Fit:
    """Simulates the model and its difference quotients, and returns the fit at the present values."""
    count = 0 if known is None else known.shape[-1]
    steps = [difference_step(model.parameters[path], model.settings[path].value) for path in paths[count:]]
    variants = [model]
    for path, step in zip(paths[count:], steps, strict=True):
        variants.append(with_values(model, {path: model.settings[path].value + step}))
    whole = np.empty((*shooting.measured.shape, 1 + len(paths)))
    columns = whole[..., 1:]
    if known is not None:
        columns[..., :count] = known
    residual = shooting.linearised(variants, steps, columns[..., count:])
    whole[..., 0] = residual
    products = shooting.elimination.products(residual[None])
    # The noise scale and the reduction by the starts depend on each other; two rounds are enough for a guess.
    for _ in range(2):
        values, found = _objectives(products, shooting, scale)
        scale = found[:, 0]
    reduced = shooting.eliminated(whole, scale)
    flat = reduced.reshape(-1, reduced.shape[-1])
    gram = flat.T @ flat
    slope, curvature = gram[1:, 0], gram[1:, 1:]
    low, high = bounds_of(model, paths)
    now = np.array([model.settings[path].value for path in paths])
    size = np.array([typical_change(model.parameters[path]) for path in paths])
    # At a bound, and the objective would decrease only beyond it.
    at_bound = ((now <= low + 1e-9 * size) & (slope > 0)) | ((now >= high - 1e-9 * size) & (slope < 0))
    # A typical change of the parameter moves the residual by less than 1e-4 of the noise: the data do not contain it.
    insensitive = np.diagonal(curvature) * size**2 < 1e-8 * shooting.size.sum()
    free = ~(at_bound | insensitive)
    return Fit(
        model, paths, float(values[0]), scale, reduced[..., 0], reduced[..., 1:], columns, free, (curvature, slope)
    )


def _gauss_newton_step(at: Fit, damping: float) -> FloatArray | None:
    """Returns the Gauss-Newton step (paths,) of the free parameters, clipped to the bounds; None if none is free."""
    if not at.free.any():
        return None
    curvature, slope = at.normal[0][np.ix_(at.free, at.free)], at.normal[1][at.free]
    curvature = curvature + np.diag(damping * np.diag(curvature) + at.prior[at.free])
    now = at.values
    values = now.copy()
    values[at.free] -= regularized_inverse(curvature) @ slope
    return np.asarray(np.clip(values, *bounds_of(at.model, at.paths)) - now)


def with_values(model: PhysicsModel, values: dict[str, float]) -> PhysicsModel:
    """Returns the model with other parameter values; free parameters stay free."""
    return model.with_settings({path: Setting(value, model.settings[path].free) for path, value in values.items()})


def regularized_inverse(matrix: FloatArray, smallest: float = 1e-7) -> FloatArray:
    """Returns pseudo-inverses of symmetric matrices (..., n, n), truncated after scaling the diagonals to 1.

    Directions with less than ``smallest`` of the largest curvature get 0, so a step does not move along them.
    """
    size = np.sqrt(np.maximum(np.diagonal(matrix, axis1=-2, axis2=-1), 1e-300))
    outer = size[..., :, None] * size[..., None, :]
    # Scaled first, because parameters have different units and the truncation is relative.
    return np.asarray(np.linalg.pinv(matrix / outer, rcond=smallest, hermitian=True) / outer)


def products_of(columns: FloatArray, residual: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Returns, by window, the products of columns (windows, n, paths) with each other and with a residual (windows, n).

    Shapes: (windows, paths, paths) and (windows, paths).
    """
    transposed = columns.swapaxes(1, 2)
    return transposed @ columns, (transposed @ residual[..., None])[..., 0]


def bounds_of(model: PhysicsModel, paths: Iterable[str]) -> tuple[FloatArray, FloatArray]:
    """Returns the lower and upper bounds of parameters, (paths,) each."""
    found = [model.parameters[path] for path in paths]
    return np.array([item.low for item in found]), np.array([item.high for item in found])


def typical_change(parameter: Parameter) -> float:
    """Returns the typical size of a change of a parameter, in its unit."""
    neutral = parameter.neutral
    # An angle, for example, has no typical size: take a share of its range.
    if parameter.typical == 0.0 and not neutral:
        return 0.05 * (parameter.high - parameter.low)
    change = abs(parameter.typical - neutral) if neutral is not None else 0.0
    # The floor keeps parameters whose neutral value is typical (a gain of 1) from having no scale at all.
    return max(min(change, 10 * abs(parameter.typical) + 1e-12), 0.05 * abs(parameter.typical), 1e-4)


def difference_step(parameter: Parameter, value: float) -> float:
    """Returns the step of a difference quotient, with the sign that stays within the bounds."""
    # 1 % of a typical change: small against curvature, large against rounding in the rollout.
    step = min(0.01 * typical_change(parameter), 0.05 * (parameter.high - parameter.low))
    return step if value + step <= parameter.high else -step
