"""Finds states that read otherwise from a jump on, although the model depends on their value.

A jump of a position is cut. That suffices where the motion does not depend on the position, as after a relocalisation.
The angle of a joint with gravity is another matter: a sensor that was recalibrated looks like another gravity. With the
jump J from the row before to the row after it, less what the model predicts for that row, the residuals of the windows
after it are compared as they are and with the state read J less:

    fall = log(sum min(r^2, c) / sum min(r_J^2, c))

A fall of the windows after it, and a rise of those before, says that the sensor changed and not the robot.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.comparison.rollout import rollout_at
from safedpa.comparison.windows import Windows, windows_of
from safedpa.dynamics import PhysicsModel
from safedpa.records.run import Finding, Run, Stretch

__all__ = ["recalibrated_states"]

_OVERLAP, _TESTED_WINDOWS = 0.5, 400
_LEAST_WINDOWS = 10
# Steps of time between two stretches that are one jump and no gap.
_LONGEST_STEP = 1.75
# Stretches that follow one another beyond which they are outliers, and no new calibration.
_MOST_BORDERS = 50
# Usual errors of one step from which a difference is a jump, and the largest jumps that are looked at.
_JUMP, _MOST_JUMPS = 10.0, 5
# Falls of the log of the squares after the jump: of one state, and of all together.
_FALL_OF_ONE, _FALL_OF_ALL = 0.3, 0.4
# Multiple of the median beyond which a square counts no more.
_CLIP = 9.0


def recalibrated_states(model: PhysicsModel, run: Run, seconds: float) -> list[Finding]:
    """Returns a finding for the state whose changed reading explains most, if any; windows last ``seconds``."""
    borders = [
        (before, after)
        for before, after in zip(run.stretches, run.stretches[1:], strict=False)
        if 0.0 < float(run.t[after.start] - run.t[before.stop - 1]) < _LONGEST_STEP * run.period
    ]
    if not 0 < len(borders) <= _MOST_BORDERS:
        return []
    every = windows_of([run], seconds, every=_OVERLAP * seconds)
    windows = every.select(np.unique(np.linspace(0, len(every) - 1, _TESTED_WINDOWS).astype(np.int64)))
    found = []
    # Predictions may overflow where the model is unstable; those windows are left out.
    with np.errstate(all="ignore"):
        for row, state, size in _jumps(model, run, borders):
            after = windows.t[windows.start] >= run.t[row]
            falls = [_falls(model, windows.select(np.flatnonzero(part)), state, size) for part in (after, ~after)]
            if falls[0].max() > _FALL_OF_ONE and falls[0].sum() > _FALL_OF_ALL and falls[1].sum() < 0.0:
                found.append((float(falls[0].sum()), row, state, size))
    return [_finding_of(run, *max(found)[1:])] if found else []


def _jumps(
    model: PhysicsModel, run: Run, borders: Sequence[tuple[Stretch, Stretch]]
) -> Iterator[tuple[int, int, float]]:
    """Yields (row after it, state, size) of the largest jumps between two stretches, of the state that jumps most."""
    steps = windows_of([run], run.period, every=run.period)
    usual = np.median(np.abs(_residuals(model, steps)), axis=0) + 1e-12
    latent, found = model.latent if model.latent_names else None, []
    for before, after in borders:
        at = before.stop - 1
        memory = model.initial_memory(run.actions[at], latent)
        period = float(run.t[after.start] - run.t[at])
        predicted, _ = model.advance(run.states[at], run.actions[at], memory, latent, period=period)
        jump = run.system.difference(run.states[after.start], predicted)
        state = int(np.argmax(np.abs(jump) / usual))
        if abs(jump[state]) > _JUMP * usual[state]:
            found.append((float(abs(jump[state]) / usual[state]), after.start, state, float(jump[state])))
    yield from (item[1:] for item in sorted(found, reverse=True)[:_MOST_JUMPS])


def _residuals(model: PhysicsModel, windows: Windows) -> FloatArray:
    predicted = rollout_at(model, windows, [windows.end])[0]
    return np.asarray(model.system.difference(windows.states[windows.end], predicted))


def _falls(model: PhysicsModel, windows: Windows, state: int, size: float) -> FloatArray:
    """Returns the fall of each state (states,) if ``state`` reads ``size`` less; 0 without enough windows."""
    if len(windows) < _LEAST_WINDOWS:
        return np.zeros(windows.states.shape[1])
    states = windows.states.copy()
    states[:, state] -= size
    given = _residuals(model, windows) ** 2
    other = _residuals(model, replace(windows, states=states, memo={})) ** 2
    good = np.isfinite(given).all(axis=1) & np.isfinite(other).all(axis=1)
    if good.sum() < _LEAST_WINDOWS:
        return np.zeros(windows.states.shape[1])
    sums = [
        np.minimum(part, _CLIP * np.median(part, axis=0)).sum(axis=0) + 1e-300 for part in (given[good], other[good])
    ]
    return np.asarray(np.log(sums[0] / sums[1]))


def _finding_of(run: Run, row: int, state: int, size: float) -> Finding:
    item, at = run.system.state[state], float(run.t[row])
    more = "more" if size > 0 else "less"
    text = (
        f"{item.name} reads {abs(size):.3g} {item.unit} {more} from t = {at:.3f} s on, and the "
        "model predicts the motion since then better without that: its sensor looks recalibrated; nothing was cut; "
        'correct the column, or set keep = ["offset"] in a column map if the robot itself changed'
    )
    return Finding("offset", text, 1, at)
