"""The theory's bound from recordings of a robot whose environment no one knows: the error of whole steps, by norms.

With the latent at work as the definition of z, eps_z is 0 and eps_f + eps_g |u|_1 + eps_r is |v - v^|_sup, which can be
measured. Times the largest gradient of h it is a margin: that of Theorem 1, as far as a recording can tell.

The bound holds for any scales of the state's entries. Here they are what the entries' own errors come to on some
transitions that are then left aside, so that no entry's error speaks for the others.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, final

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray
from safedpa.dynamics import PhysicsModel
from safedpa.errors import InputError
from safedpa.networks import frame_of
from safedpa.robot import robot_like
from safedpa.safety.margins.conformal import split_conformal_margin
from safedpa.safety.settings import FilterSettings

__all__ = ["RecordedBound", "RecordedSteps", "own_errors", "recorded_bound"]


_BLOCK = 100
"""Transitions of a block; the first of every ten blocks sets the scales."""
_SMALLEST_SCALE = 1e-6


class RecordedSteps(Protocol):
    """n steps of a robot: states (n, states), actions (n, actions), latents at work (n, latents), in SI units."""

    state: FloatArray
    action: FloatArray
    following: FloatArray
    latent: FloatArray
    footprints: set[tuple[float, ...]]
    """(rear, front, radius) [m] that occur in them."""


@final
@dataclass(frozen=True)
class RecordedBound:
    """Margins by kind of barrier, and the constants that they are products of; both empty for robots but the car."""

    margins: dict[str, float]
    constants: dict[str, float]


def recorded_bound(
    model: PhysicsModel, settings: FilterSettings, found: RecordedSteps, used: NDArray[np.bool_], coverage: float
) -> RecordedBound:
    """epsilon = P eps with eps the split conformal quantile of |v - v^|_sup over the ``used`` (n,) transitions.

    P is the largest gradient for any of the recorded footprints. Raises InputError when too few transitions are used
    for the coverage.
    """
    robot = robot_like(model.system)
    if robot is None or not robot.theorem_margins:
        return RecordedBound({}, {})
    errors = np.abs(own_errors(model, found))
    scaling = used & (np.arange(len(used)) // _BLOCK % 10 == 0)
    scale = np.maximum(np.quantile(errors[scaling], coverage, axis=0), _SMALLEST_SCALE)
    steps = (errors[used & ~scaling] / scale).max(axis=-1)
    step = split_conformal_margin(steps, coverage)
    if not np.isfinite(step):
        raise InputError(f"transitions: got {len(steps)}, too few for a coverage of {coverage}; record more")
    tables = [robot.largest_gradients(settings, footprint, scale) for footprint in found.footprints]
    gradients = {kind: max(table[kind] for table in tables) for kind in tables[0]}
    constants = {
        "step": step,
        **{f"scale.{name}": float(value) for name, value in zip(model.system.state_names, scale, strict=True)},
        **{f"gradient.{kind}": value for kind, value in gradients.items()},
    }
    return RecordedBound({kind: value * step for kind, value in gradients.items()}, constants)


def own_errors(model: PhysicsModel, found: RecordedSteps) -> FloatArray:
    """Measured minus predicted increment (n, states) in the robot's own frame, SI units."""
    frame = frame_of(model.system.name)
    expected = model.step(found.state, found.action, found.latent)
    measured = frame.own_increment(found.state, found.following)
    return np.asarray(measured - frame.own_increment(found.state, expected))
