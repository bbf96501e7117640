"""What the tests of live diagnosis share: a car that is its own model, plus noise, plus what changes."""

from collections.abc import Callable, Iterator
from math import sin

import numpy as np
import pytest
from tests import messages

from safedpa.bus import LatentMessage, StateMessage, VerdictMessage
from safedpa.dynamics import PhysicsModel, Setting, load_model
from safedpa.effects import effect
from safedpa.live.search_jobs import AbstractWorker, SearchJob, WorkOutcome

PERIOD = 0.05
Row = tuple[int, np.ndarray, np.ndarray]


@pytest.fixture(scope="session")
def car() -> PhysicsModel:
    """The measured car: lag, slip and drag, nothing free."""
    return load_model("car_measured")


@pytest.fixture(scope="session")
def drive_of(car: PhysicsModel) -> Callable[..., Iterator[Row]]:
    """drive_of(ticks, change_at, effect, numbers): tick, measured state, what was applied before it."""

    def drive(ticks: int, change_at: int | None = None, name: str = "", seed: int = 0, **numbers: float):
        random = np.random.default_rng(seed)
        changed = car.with_effect(effect("car", name), {k: Setting(v) for k, v in numbers.items()}) if name else car
        model, state = car, np.zeros(4)
        action = np.zeros(2)
        memory = model.initial_memory(action)
        for tick in range(ticks):
            if tick == change_at:
                model, memory = changed, changed.initial_memory(action)
            yield tick, state + random.normal(0.0, [1e-3, 1e-3, 1e-3, 5e-3]), action
            t = tick * PERIOD
            action = np.array(
                [1.0 + 0.5 * sin(0.7 * t) + 0.2 * sin(2.9 * t), 0.25 * sin(0.45 * t) + 0.08 * sin(2.1 * t)]
            )
            state, memory = model.advance(state, action, memory)

    return drive


@pytest.fixture(scope="session")
def state_of() -> Callable[[Row], StateMessage]:
    """The message of a row."""
    return _state


@pytest.fixture(scope="session")
def verdict_of() -> Callable[[StateMessage], VerdictMessage]:
    """A verdict of the state's tick with h far from its margin."""
    return _verdict


def _state(row: Row) -> StateMessage:
    tick, values, applied = row
    return messages.state_of(
        *values.tolist(), **messages.stamp(tick, PERIOD, epoch=3), applied=tuple(applied.tolist()),
        applied_by="filter" if tick else "none", lockstep=True, goal=(1.0, 0.0), field=(-50.0, 50.0, -50.0, 50.0),
        footprint=(0.08, 0.4, 0.12),
    )  # fmt: skip


def _verdict(state: StateMessage) -> VerdictMessage:
    return messages.verdict_of("passed", **messages.stamp(state.tick, PERIOD, epoch=3), margin=0.01)


def latent_of(state: StateMessage, model: str) -> LatentMessage:
    return messages.latent_of(**messages.stamp(state.tick, PERIOD, epoch=3), model=model)


class HandedWorker(AbstractWorker):
    """Remembers what it was given; outcomes come when the test says so."""

    def __init__(self) -> None:
        self.begun: list[SearchJob] = []
        self.cancelled = 0
        self.gave_way = 0
        self.ready: WorkOutcome | None = None
        self._busy = False

    def begin(self, robot: str, work: SearchJob) -> None:
        del robot
        self.begun.append(work)
        self._busy = True

    def outcome(self, robot: str) -> WorkOutcome | None:
        del robot
        found, self.ready = self.ready, None
        self._busy = self._busy and found is None
        return found

    def cancel(self, robot: str) -> None:
        del robot
        self.cancelled += self._busy
        self._busy, self.ready = False, None

    def give_way(self) -> None:
        self.gave_way += 1

    def busy(self, robot: str) -> bool:
        del robot
        return self._busy


@pytest.fixture
def worker() -> HandedWorker:
    """One of those."""
    return HandedWorker()


@pytest.fixture(scope="session")
def worker_class() -> type[HandedWorker]:
    """For tests that share one among them."""
    return HandedWorker
