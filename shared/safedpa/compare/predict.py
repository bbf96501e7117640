"""Open-loop predictions as a table."""

from __future__ import annotations

import numpy as np

from safedpa.compare.rollout import rollout
from safedpa.compare.windows import Floats, windows_of
from safedpa.dynamics import PhysicsModel
from safedpa.records.run import Run

__all__ = ["predict_run"]


def predict_run(model: PhysicsModel, run: Run, horizon: float, *, stride: int = 10) -> dict[str, Floats]:
    """Predictions from every ``stride``-th trusted row: columns start_t, t [s] and the states by name.

    One entry per measured row after the start, up to and including the horizon (to half a period) or the end of the
    stretch, whichever comes first; starts in order, and within a start by time. Only the state at the start and the
    run's actions before t enter a prediction at t. Raises InputError and RunError as ``windows_of`` does.
    """
    windows = windows_of([run], horizon, stride=stride, partial=True)
    predicted = rollout(model, windows)[1:]
    step = np.arange(1, len(predicted) + 1)
    there = step[None, :] <= windows.steps[:, None]
    rows = (windows.start[:, None] + step[None, :])[there]
    starts = np.repeat(windows.start, windows.steps)
    states = predicted.transpose(1, 0, 2)[there]
    columns = {"start_t": windows.t[starts], "t": windows.t[rows]}
    return columns | {name: states[:, index] for index, name in enumerate(windows.system.state_names)}
