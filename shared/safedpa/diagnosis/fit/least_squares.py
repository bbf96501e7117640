"""Parameters of named effects by weighted nonlinear least squares on short rollouts, and how well they hold elsewhere.

minimise sum over the states s of size_s log(sum of squares of the reduced residual of s): each state's noise is unknown
and is estimated next to the parameters. Gauss-Newton steps with bounds; derivatives by differences.

Source: Seber and Wild, Nonlinear Regression, Wiley 1989, ch. 11; Efron and Tibshirani, An Introduction to the
Bootstrap, 1993, ch. 11 (jackknife).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray
from safedpa.diagnosis.fit.multiple_shooting import Shooting
from safedpa.diagnosis.fit.variable_projection import ProjectedProducts
from safedpa.dynamics import PhysicsModel
from safedpa.dynamics.settings import Setting
from safedpa.effects.parameter import Parameter

__all__ = [
    "Fit",
    "bounds_of",
    "difference_step",
    "fit",
    "jackknife",
    "known_slopes",
    "objectives",
    "products_of",
    "regularized_inverse",
    "typical_change",
    "with_values",
]  # fmt: skip

_STEPS = 8
_DONE = 2e-4
"""Fall of the objective per independent number below which a fit has converged."""
_HARDLY = 0.1
"""Of that: a step that takes less is not simulated again."""
_BEGUN, _NEARLY = 3, 2e-3
"""Steps with slopes that are known, and the fall below which they have done what they can."""
_FALLING = 0.02
"""Fall in the last of them, from which no one knows yet where the fit ends."""
_BEHIND = 4.0
"""Times the fall of a step: steps that shrink by a fifth each take no more than that from there on."""


@dataclass(frozen=True)
class Fit:
    """A model with fitted parameters.

    residual (windows, compared * states) and columns (..., paths): reduced, in units of ``scale`` (states,);
    ``slopes`` (windows, compared, states, paths): columns before that, in the states' units.
    """

    model: PhysicsModel
    paths: tuple[str, ...]
    value: float
    """The objective per independent number."""
    scale: FloatArray
    residual: FloatArray
    columns: FloatArray
    slopes: FloatArray
    free: NDArray[np.bool_]
    """Parameters that do not stand at a bound that holds them, (paths,)."""
    normal: tuple[FloatArray, FloatArray]
    """Products of the columns with each other (paths, paths) and with the residual (paths,), where it was
    linearised."""
    stated: FloatArray | None = None
    """Standard deviations (paths,) where another way of fitting gave them."""

    @property
    def values(self) -> FloatArray:
        """(paths,)"""
        return np.array([self.model.settings[path].value for path in self.paths])

    @property
    def prior(self) -> FloatArray:
        """Curvature that keeps a direction without any of its own from moving by more than some ordinary changes,
        (paths,)."""
        return np.array([(5.0 * typical_change(self.model.parameters[path])) ** -2 for path in self.paths])

    def deviations(self, shooting: Shooting) -> FloatArray:
        """One standard deviation of each parameter (paths,).

        The larger of jackknives over blocks of time and over runs, where there are four; at least what white residuals
        would give.

        (B - 1) / B sum over the blocks of (parameters without the block - parameters)^2, to first order. At a bound the
        distance into the allowed side over which the squares grow by one unit of the noise (profile likelihood); NaN
        where the data say nothing.
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
        for group in (shooting.block, shooting.windows.run):
            count = len(np.unique(group))
            if group is shooting.block or count >= _FEWEST_RUNS:
                squares = np.maximum(squares, jackknife(products, slopes, group))
        found[self.free] = np.sqrt(np.maximum(squares, 0.0))
        return found

    def _at_bounds(self) -> FloatArray:
        """One-sided deviations of what is not free (paths,), else NaN: d with 2 |g| d + h d^2 = 1.

        g and h are slope and curvature of half the squares in units of the noise.
        """
        flat = self.columns.reshape(self.residual.size, len(self.paths))
        slope, curvature = np.abs(flat.T @ self.residual.reshape(-1)), (flat**2).sum(axis=0)
        low, high = bounds_of(self.model, self.paths)
        with np.errstate(all="ignore"):
            distance = (np.sqrt(slope**2 + curvature) - slope) / curvature
        reported = ~self.free & np.isfinite(distance) & (distance > 0) & (distance < high - low)
        return np.where(reported, distance, np.nan)

    def without(self, shooting: Shooting) -> dict[int, FloatArray]:
        """Parameters (paths,) fitted without each fold, to first order, by fold."""
        folds = np.unique(shooting.fold)
        values, free = np.tile(self.values, (len(folds), 1)), self.free
        if free.any() and len(folds) > 1:
            curvature, slope = products_of(self.columns[..., free], self.residual)
            used = [shooting.fold != fold for fold in folds]
            parts = np.stack([curvature[own].sum(axis=0) for own in used]) + np.diag(self.prior[free])
            slopes = np.stack([slope[own].sum(axis=0) for own in used])
            values[:, free] -= (regularized_inverse(parts, _SETTLED) @ slopes[..., None])[..., 0]
        return dict(zip(folds.tolist(), np.clip(values, *bounds_of(self.model, self.paths)), strict=True))

    def heldout_squares(self, shooting: Shooting) -> FloatArray:
        """Squares (windows, states) of the reduced residual in the states' units, fitted without the window's fold."""
        shift = np.zeros((len(shooting.windows), len(self.paths)))
        for fold, values in self.without(shooting).items():
            shift[shooting.fold == fold] = values - self.values
        residual = self.residual + (self.columns @ shift[..., None])[..., 0]
        return np.asarray(shooting.squares(residual) * self.scale**2)


def jackknife(products: FloatArray, slopes: FloatArray, group: NDArray[np.int64]) -> FloatArray:
    """Squares of the deviations (paths,) by what each group of windows moves, to first order."""
    count, size = int(group.max()) + 1, products.shape[-1]
    curvature, slope = np.zeros((count, size, size)), np.zeros((count, size))
    np.add.at(curvature, group, products)
    np.add.at(slope, group, slopes)
    there = np.unique(group)
    whole, total = curvature.sum(axis=0), slope.sum(axis=0)
    shifts = (regularized_inverse(whole - curvature[there]) @ (total - slope[there])[..., None])[..., 0]
    share = (len(there) - 1) / max(len(there), 1)
    return np.asarray(((shifts - shifts.mean(axis=0)) ** 2).sum(axis=0) * share)


_FEWEST_RUNS = 4
"""Runs whose differences say how sure a number is."""
_SETTLED = 3e-3
"""Share of the curvature below which a direction stays where all folds put it: valleys of a fit are bent, and a
straight step along one leaves it."""


def fit(
    model: PhysicsModel,
    paths: Sequence[str],
    shooting: Shooting,
    scale: FloatArray,
    steps: int = _STEPS,
    known: FloatArray | None = None,
    enough: float = np.inf,
) -> Fit:
    """The parameters ``paths`` of a model, from where they stand; ``scale`` (states,): a guess of the noise.

    ``known`` (windows, compared, states, some): slopes of the first paths, taken as they are; a rough fit saves half
    of its rollouts so. With a bound ``enough`` of the objective a fit begins with them and goes on with its own only
    where it is below that, or still falls fast and has a bound to come to: a slope of a number that hardly moves
    changes little, and most fits are of no use to anyone who asks.
    """
    names = tuple(paths)
    best = _linearised(model, names, shooting, scale, known)
    if known is not None and enough < np.inf:
        begun, fall = _descended(best, shooting, _BEGUN, known, _NEARLY)
        if begun.value > enough and (fall < _FALLING or enough == -np.inf):
            return begun
        best = _linearised(begun.model, names, shooting, begun.scale, None)
        known = None
    return _descended(best, shooting, steps, known, _DONE, enough)[0]


def _descended(
    best: Fit, shooting: Shooting, steps: int, known: FloatArray | None, done: float, enough: float = np.inf
) -> tuple[Fit, float]:
    """Gauss-Newton steps until the objective falls by less than ``done``; and by how much it fell in the last one.

    A last step that by its slopes takes _HARDLY anything is not simulated again: what it changes follows from them. A
    fit that no longer falls fast and is farther above ``enough`` than _BEHIND times the last step's fall is left.
    """
    damping = fall = 0.0
    for _ in range(steps):
        shift = _step_of(best, damping)
        if shift is None:
            break
        if damping == 0.0 and steps > 1:
            last = _along(best, shift, shooting, _HARDLY * done)
            if last is not None:
                return last, 0.0
        new = _linearised(_shifted(best, shift), best.paths, shooting, best.scale, known)
        if new.value < best.value:
            fall, best, damping = best.value - new.value, new, 0.0 if damping < 0.1 else 0.1 * damping
            if fall < done or (fall < _FALLING and best.value - enough > _BEHIND * fall):
                break
        else:
            damping = 0.05 if damping == 0.0 else 10.0 * damping
            if damping > 100.0:
                break
    return best, fall


def _along(at: Fit, shift: FloatArray, shooting: Shooting, done: float) -> Fit | None:
    """The fit after a step (paths,) that is so small that the slopes tell what it changes; None where it is not, or
    ends at a bound."""
    values = at.values + shift
    low, high = bounds_of(at.model, at.paths)
    if ((values <= low) | (values >= high))[at.free].any():
        return None
    residual = at.residual + at.columns @ shift
    fall = 0.5 * float((at.residual**2).sum() - (residual**2).sum()) / float(shooting.size.sum())
    if not 0.0 <= fall < done:
        return None
    return replace(at, model=_shifted(at, shift), value=at.value - fall, residual=residual)


def _shifted(at: Fit, shift: FloatArray) -> PhysicsModel:
    values = np.clip(at.values + shift, *bounds_of(at.model, at.paths))
    return with_values(at.model, dict(zip(at.paths, values.tolist(), strict=True)))


def known_slopes(fitted: Fit, paths: Sequence[str]) -> FloatArray:
    """Slopes of the first of some paths, as far as another fit has them: what ``fit`` may begin with."""
    own = {path: index for index, path in enumerate(fitted.paths)}
    count = next((index for index, path in enumerate(paths) if path not in own), len(paths))
    return np.asarray(fitted.slopes[..., [own[path] for path in paths[:count]]])


def objectives(residuals: FloatArray, shooting: Shooting, scale: FloatArray) -> FloatArray:
    """The objective per independent number of residuals (models, windows, compared, states), (models,)."""
    return _objectives(shooting.elimination.products(residuals), shooting, scale)[0]


def _objectives(products: ProjectedProducts, shooting: Shooting, scale: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(objectives per independent number (models,), each state's root mean square (states, models)), never 0."""
    squares = shooting.elimination.squares(products, scale)
    found = np.maximum(np.sqrt(squares / shooting.size[:, None]), 1e-6)
    return shooting.size @ np.log(found) / shooting.size.sum(), found


def _linearised(
    model: PhysicsModel, paths: tuple[str, ...], shooting: Shooting, scale: FloatArray, known: FloatArray | None
) -> Fit:
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
    held = ((now <= low + 1e-9 * size) & (slope > 0)) | ((now >= high - 1e-9 * size) & (slope < 0))
    dead = np.diagonal(curvature) * size**2 < 1e-8 * shooting.size.sum()
    free = ~(held | dead)
    return Fit(
        model, paths, float(values[0]), scale, reduced[..., 0], reduced[..., 1:], columns, free, (curvature, slope)
    )


def _step_of(at: Fit, damping: float) -> FloatArray | None:
    """The Gauss-Newton step (paths,) of the free parameters, cut at the bounds; None where none is free."""
    if not at.free.any():
        return None
    curvature, slope = at.normal[0][np.ix_(at.free, at.free)], at.normal[1][at.free]
    curvature = curvature + np.diag(damping * np.diag(curvature) + at.prior[at.free])
    now = at.values
    values = now.copy()
    values[at.free] -= regularized_inverse(curvature) @ slope
    return np.asarray(np.clip(values, *bounds_of(at.model, at.paths)) - now)


def with_values(model: PhysicsModel, values: dict[str, float]) -> PhysicsModel:
    """The model with other numbers; what is free stays free."""
    return model.with_settings({path: Setting(value, model.settings[path].free) for path, value in values.items()})


def regularized_inverse(matrix: FloatArray, smallest: float = 1e-7) -> FloatArray:
    """Inverses of symmetric matrices (..., n, n) whose diagonals were scaled to 1; directions without any curvature do
    not move."""
    size = np.sqrt(np.maximum(np.diagonal(matrix, axis1=-2, axis2=-1), 1e-300))
    around = size[..., :, None] * size[..., None, :]
    return np.asarray(np.linalg.pinv(matrix / around, rcond=smallest, hermitian=True) / around)


def products_of(columns: FloatArray, residual: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Products of reduced columns (windows, numbers, paths) with each other and with the residual (windows, numbers),
    window by window: (windows, paths, paths) and (windows, paths)."""
    turned = columns.swapaxes(1, 2)
    return turned @ columns, (turned @ residual[..., None])[..., 0]


def bounds_of(model: PhysicsModel, paths: Iterable[str]) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest values, (paths,) each."""
    found = [model.parameters[path] for path in paths]
    return np.array([item.low for item in found]), np.array([item.high for item in found])


def typical_change(parameter: Parameter) -> float:
    """The size of a change that is ordinary."""
    neutral = parameter.neutral
    if parameter.typical == 0.0 and not neutral:  # an angle, say, of which no size is ordinary
        return 0.05 * (parameter.high - parameter.low)
    change = abs(parameter.typical - neutral) if neutral is not None else 0.0
    return max(min(change, 10 * abs(parameter.typical) + 1e-12), 0.05 * abs(parameter.typical), 1e-4)


def difference_step(parameter: Parameter, value: float) -> float:
    """The step of a difference quotient that stays within the bounds."""
    step = min(0.01 * typical_change(parameter), 0.05 * (parameter.high - parameter.low))
    return step if value + step <= parameter.high else -step
