"""The margin of Theorem 1, estimated from recordings of a robot in an unknown environment by norms of one-step errors.

With the latent in use as the definition of z, eps_z is 0, and eps_f + eps_g |u|_1 + eps_r equals |v - v^|_sup, which
can be measured. Its product with the largest gradient of h is the margin of Theorem 1, as far as a recording shows it.

The bound holds for any scaling of the state's entries. Here each entry is scaled by its own errors on some transitions
that are then left out, so that the error of one entry does not dominate the others.
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
from safedpa.safety.margins.conformal import split_conformal_margin
from safedpa.safety.settings import FilterSettings
from safedpa.systems.robots import robot_like

# Transitions per block; the first of every ten blocks determines the scales.
_BLOCK = 100
_SMALLEST_SCALE = 1e-6


class StepArrays(Protocol):
    """n steps of a robot: states (n, states), actions (n, actions) and latents in use (n, latents), in SI units."""

    state: FloatArray
    action: FloatArray
    following: FloatArray
    latent: FloatArray
    footprints: set[tuple[float, ...]]
    """(rear, front, radius) [m] of the robots."""


@final
@dataclass(frozen=True)
class RecordedBound:
    """Margins by kind of barrier, and the constants of which they are products; both empty except for the car."""

    margins: dict[str, float]
    constants: dict[str, float]


def recorded_bound(
    model: PhysicsModel, settings: FilterSettings, found: StepArrays, used: NDArray[np.bool_], coverage: float
) -> RecordedBound:
    """Returns epsilon = P eps with eps the split conformal quantile of |v - v^|_sup over the ``used`` (n,) transitions.

    P is the largest gradient over the recorded footprints. Raises InputError for too few transitions for the coverage.
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


def own_errors(model: PhysicsModel, found: StepArrays) -> FloatArray:
    """Returns measured minus predicted increment (n, states) in the robot's own frame, in SI units."""
    frame = frame_of(model.system.name)
    expected = model.step(found.state, found.action, found.latent)
    measured = frame.own_increment(found.state, found.following)
    return np.asarray(measured - frame.own_increment(found.state, expected))
