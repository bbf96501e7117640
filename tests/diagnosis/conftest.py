"""Runs that a model itself drove: what holds for them is known."""

from collections.abc import Callable, Sequence
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from safedpa.diagnosis import diagnose as diagnosis
from safedpa.dynamics import PhysicsModel, Setting
from safedpa.effects import effect
from safedpa.records.run import Run, Stretch
from safedpa.robots.car.dynamics.kinematic_bicycle import KinematicBicycle

Drive = Callable[..., Run]


@pytest.fixture
def plain() -> PhysicsModel:
    """A car with throttle and no effect."""
    own = {"base.wheelbase": Setting(0.3), "base.drive_gain": Setting(3.0)}
    return PhysicsModel(KinematicBicycle("throttle"), [], own)


@pytest.fixture
def with_effect() -> Callable[..., PhysicsModel]:
    def add(model: PhysicsModel, name: str, **parameters: float) -> PhysicsModel:
        return model.with_effect(effect("car", name), {key: Setting(value) for key, value in parameters.items()})

    return add


@pytest.fixture
def drive() -> Drive:
    """drive(model, seconds, seed, ...): what the model does under a random drive, without noise, as a run.

    ``faster`` is added to the first action: of a car with a speed servo a target [m/s].
    """

    def simulate(
        model: PhysicsModel,
        seconds: float = 40.0,
        seed: int = 0,
        *,
        jitter: float = 0.0,
        period: float = 0.05,
        name: str = "simulated",
        stretches: Sequence[tuple[int, int]] | None = None,
        start: Sequence[float] = (0.0, 0.0, 0.0, 1.0),
        faster: float = 0.0,
    ) -> Run:
        random = np.random.default_rng(seed)
        rows = round(seconds / period)
        t = np.concatenate([[0.0], np.cumsum(period * (1.0 + jitter * random.uniform(-1, 1, rows - 1)))])
        actions = _held(random, rows, round(0.4 / period))
        actions[:, 0] += faster
        states = np.zeros((rows, 4))
        states[0] = start
        memory = model.initial_memory(actions[0])
        for row in range(rows - 1):
            now, lasts = float(t[row]), float(t[row + 1] - t[row])
            states[row + 1], memory = model.advance(states[row], actions[row], memory, period=lasts, time=now)
        parts = tuple(Stretch(*part) for part in (stretches or [(0, rows)]))
        return Run(name, model.system, t, states, actions, parts)

    return simulate


def _held(random: np.random.Generator, rows: int, hold: int) -> np.ndarray:
    """Throttle around 0 and steer, each held for a while, so that speeds come and go between about -1 and 4 m/s."""
    blocks = -(-rows // hold)
    throttle = np.repeat(random.uniform(-1.0, 1.0, blocks), hold)[:rows]
    # pulls the speed back to 1.5 m/s: an integrator under random throttle would wander off
    speed = 1.0
    for row in range(rows):
        throttle[row] = np.clip(throttle[row] + 0.6 * (1.5 - speed), -1.0, 1.0)
        speed += 3.0 * throttle[row] * 0.05
    steer = np.repeat(random.uniform(-0.4, 0.4, blocks), hold)[:rows]
    return np.stack([throttle, steer], axis=1)


@pytest.fixture
def data(data_folder: Path) -> Path:
    """The folder of real logs; skips where it is absent."""
    return data_folder


@pytest.fixture
def searched_once(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The search runs once; who searches again is given the same answer, if the question is the same.

    What is returned holds the question and the answer, once something was asked.
    """
    asked: list[Any] = []
    search = diagnosis.run_search

    def once(model: Any, library: Any, shooting: Any, heldout: Any, *others: Any) -> Any:
        if not asked:
            asked.append((model, library, shooting, heldout))
            asked.append(search(model, library, shooting, heldout, *others))
            return deepcopy(asked[1])
        before = asked[0]
        assert (model, library) == before[:2]
        for own, other in ((shooting, before[2]), (heldout, before[3])):
            np.testing.assert_array_equal(own.fold, other.fold)
            for name in ("start", "steps", "states", "actions", "period"):
                np.testing.assert_array_equal(getattr(own.windows, name), getattr(other.windows, name))
        np.testing.assert_array_equal(shooting.rows, before[2].rows)
        np.testing.assert_array_equal(shooting.counts, before[2].counts)
        return deepcopy(asked[1])

    monkeypatch.setattr(diagnosis, "run_search", once)
    return asked
