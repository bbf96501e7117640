"""Which transitions of a run are predicted, from which memory, latent and time."""

from typing import Any

import numpy as np
import pytest

from safedpa.calibration import from_runs
from safedpa.dynamics import load_model
from safedpa.records.run import Run, Stretch


class Remembers:
    """A model and an estimator that tell what they were asked."""

    period = 0.05
    latent_names = ("a",)
    latent = np.array([7.0])

    def __init__(self) -> None:
        self.begun: list[tuple[float, float]] = []
        self.asked: list[tuple[float, float, float, float, float]] = []
        self.learned: list[tuple[float, float, float, float]] = []

    def initial_memory(self, action: np.ndarray, latent: np.ndarray) -> float:
        self.begun.append((float(action[0]), float(latent[0])))
        return 1.0

    def advance(self, state, action, memory, latent, *, period, time):
        self.asked.append((float(state[0]), float(latent[0]), memory, round(period, 6), round(time, 6)))
        return state + action, memory + 1.0

    def update(self, state: np.ndarray, action: np.ndarray, following: np.ndarray, period: float) -> None:
        self.learned.append((float(state[0]), float(action[0]), float(following[0]), period))


def reported(rows: int, *stretches: Stretch) -> Run:
    t = 5.0 + 0.05 * np.arange(rows)
    t[4:] += 0.15
    states = 10.0 + np.arange(float(rows))[:, None]
    return Run("run", load_model("pendulum").system, t, states, 0.5 + np.arange(float(rows))[:, None], stretches)


def test_each_transition_is_predicted_from_what_was_known_then() -> None:
    """Actuators remember along a stretch, over rows of another period too; these are neither counted nor learned."""
    model: Any = Remembers()
    rows = list(from_runs._predictions(model, [reported(8, Stretch(0, 5), Stretch(5, 8))], None))
    assert [(float(a[0]), float(b[0]), float(c[0])) for a, b, c in rows] == [
        (10.0, 10.5, 11.0), (11.0, 12.5, 12.0), (12.0, 14.5, 13.0), (15.0, 20.5, 16.0), (16.0, 22.5, 17.0),
    ]  # fmt: skip
    assert model.begun == [(0.5, 7.0), (5.5, 7.0)]
    assert model.asked == [
        (10.0, 7.0, 1.0, 0.05, 0.0), (11.0, 7.0, 2.0, 0.05, 0.05), (12.0, 7.0, 3.0, 0.05, 0.1),
        (13.0, 7.0, 4.0, 0.2, 0.15), (15.0, 7.0, 1.0, 0.05, 0.4), (16.0, 7.0, 2.0, 0.05, 0.45),
    ]  # fmt: skip


def test_the_latent_is_learned_along_each_stretch() -> None:
    model, estimator = Remembers(), Remembers()
    estimator.latent = np.array([3.0])
    known: Any = model
    list(from_runs._predictions(known, [reported(8, Stretch(0, 5), Stretch(5, 8))], lambda: estimator))
    assert {latent for _, latent, *_ in model.asked} == {3.0}
    assert estimator.learned == [(s, s - 9.5, s + 1.0, 0.05) for s in (10.0, 11.0, 12.0, 15.0, 16.0)]


@pytest.mark.parametrize(("rows", "counted"), [(3000, 2998), (6000, 3000), (9003, 3001)])
def test_of_many_transitions_as_many_as_report_the_quantile_are_taken(rows: int, counted: int) -> None:
    model: Any = Remembers()
    found = list(from_runs._predictions(model, [reported(rows, Stretch(0, rows))], None))
    assert len(found) == pytest.approx(counted, abs=1)
