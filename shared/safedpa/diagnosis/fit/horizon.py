"""Over how many seconds a model is compared with data to decide what it lacks: by the data, never by who asks.

The longest of a ladder of horizons in which an error of the start stays an error of the start, and of which the
recordings hold enough. What is long lets an effect grow above the noise; what is too long is ruled by the start (a
pendulum near upright) or leaves too few windows that are independent of each other.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from safedpa.comparison.rollout import check_system
from safedpa.comparison.rollout_error import change_scale
from safedpa.comparison.windows import check_runs, windows_of
from safedpa.diagnosis.fit.cross_validation import Heldout, heldout_of
from safedpa.diagnosis.fit.multiple_shooting import Shooting, shooting_of
from safedpa.diagnosis.fit.simulation import simulate
from safedpa.dynamics import PhysicsModel
from safedpa.errors import RunError
from safedpa.records.run import Run

__all__ = [
    "FEWEST_SECONDS",
    "FEWEST_WINDOWS",
    "LONGEST",
    "HorizonData",
    "data_at_horizon",
    "data_at_other_horizons",
    "displayed_windows",
    "recommended_recording",
    "select_horizon",
]  # fmt: skip

LONGEST = 1.0
"""s, or so many rows:"""
_ROWS = 20
_SHARES = (1.0, 0.7, 0.5, 0.35, 0.25, 0.18, 0.12)
"""Of the longest horizon: the ladder."""
_FEWEST_ROWS = 6
"""In a window."""
_ENOUGH = 20
"""Windows one after the other that are wanted."""
FEWEST_WINDOWS = 10
FEWEST_SECONDS = 5.0
"""Without which nothing can be judged."""
_GROWTH = 8.0
"""Times that an error of the start may grow, in units of each state's usual change: a pendulum near upright grows by
exp(4.4 t), so 0.4 s."""
_SAMPLED = 120
"""Windows whose growth is looked at."""
_STEP = 1e-4


@dataclass(frozen=True)
class HorizonData:
    """The same recordings at one horizon: windows to fit and windows to judge."""

    seconds: float
    shooting: Shooting
    heldout: Heldout


def data_at_horizon(runs: Sequence[Run], seconds: float) -> HorizonData:
    """Windows of ``seconds``; raises InputError and RunError as ``windows_of`` does."""
    return HorizonData(seconds, shooting_of(runs, seconds), heldout_of(runs, seconds))


def data_at_other_horizons(runs: Sequence[Run], seconds: float) -> Iterator[HorizonData]:
    """The same question at half the horizon, a fifth of it and twice as much, as far as the recordings allow."""
    period = float(np.median([run.period for run in runs]))
    for share in (0.5, 0.2, 2.0):
        if share * seconds >= _FEWEST_ROWS * period and _count(runs, share * seconds) >= FEWEST_WINDOWS:
            yield data_at_horizon(runs, share * seconds)


def select_horizon(model: PhysicsModel, runs: Sequence[Run]) -> float:
    """The horizon [s] on which the search decides for these runs, whatever is shown.

    Where of no step of the ladder there are enough windows, the shortest, of which there are most. Raises InputError
    for a model of another robot, RunError for unusable runs.
    """
    check_runs(runs)
    check_system(model.system, runs[0].system, runs[0].name)
    period = float(np.median([run.period for run in runs]))
    longest = max(LONGEST, _ROWS * period)
    hierarchy = [float(f"{share * longest:.3g}") for share in _SHARES if share * longest >= _FEWEST_ROWS * period]
    if not _count(runs, hierarchy[-1]):
        raise RunError(_too_short(runs, hierarchy[-1]))
    enough = [seconds for seconds in hierarchy[:-1] if _count(runs, seconds) >= _ENOUGH]
    return next((seconds for seconds in enough if _growth(model, runs, seconds) <= _GROWTH), hierarchy[-1])


def _too_short(runs: Sequence[Run], seconds: float) -> str:
    lasts = max(float(t[-1] - t[0]) for run in runs for t, _, _ in run.parts() if len(t))
    return (
        f"{runs[0].name}: the longest stretch without a gap lasts {lasts:.4g} s, and effects are judged over "
        f"{seconds:g} s at least; record {recommended_recording(seconds)}"
    )


def recommended_recording(seconds: float) -> str:
    """How long to record for windows of ``seconds``, in words: the fewest windows and seconds, better more."""
    least = max(FEWEST_SECONDS, FEWEST_WINDOWS * seconds)
    return f"{least:.3g} s, better " + ("a minute" if least <= 30.0 else f"{2.0 * least:.3g} s")


def displayed_windows(runs: Sequence[Run], horizon: float, evidence: HorizonData) -> Heldout:
    """Windows of the horizon that is shown; those of the evidence where it is the same."""
    same = abs(horizon - evidence.seconds) < 1e-9
    return evidence.heldout if same else heldout_of(runs, horizon)


def _count(runs: Sequence[Run], seconds: float) -> int:
    """Windows of ``seconds`` one after the other."""
    return int(sum((t[-1] - t[0] + 0.5 * run.period) // seconds for run in runs for t, _, _ in run.parts() if len(t)))


def _growth(model: PhysicsModel, runs: Sequence[Run], seconds: float) -> float:
    """By how much an error of the start grows in nine of ten windows at most, states in units of their usual change."""
    every = windows_of(runs, seconds, every=seconds)
    windows = every.select(np.unique(np.linspace(0, len(every) - 1, _SAMPLED).astype(np.int64)))
    scale = np.maximum(change_scale(every, every.end), 1e-9)
    starts = windows.states[windows.start]
    size = starts.shape[1]
    shifted = np.stack([starts, *(starts + _STEP * scale * np.eye(size)[index] for index in range(size))])
    rows = np.array([0, int(windows.steps.min())])
    with np.errstate(all="ignore"):
        ends = simulate([model] * (size + 1), windows, rows, shifted)[:, 1]
        columns = (ends[..., 1:] - ends[..., :1]) / (_STEP * scale[:, None])
    finite = np.where(np.isfinite(columns), np.clip(columns, -1e6, 1e6), 1e6)
    return float(np.quantile(np.linalg.norm(finite, ord=2, axis=(-2, -1)), 0.9))
