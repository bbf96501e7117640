"""A car with a throttle whose drag its model lacks, as a recording on disk."""

from __future__ import annotations

import asyncio
import csv
import shutil
from collections.abc import Callable, Coroutine, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from safedpa.dynamics import PhysicsModel, Setting, save_model
from safedpa.effects import effect
from safedpa.records import load_run
from safedpa.records.run import Run
from safedpa.robots.car.kinematic_bicycle import KinematicBicycle

COLUMNS = ("t", "x", "y", "yaw", "speed", "throttle", "steer")
NOISE = np.array([0.002, 0.002, 0.003, 0.015])
"""m, m, rad, m/s; of the measured states."""


def _plain() -> PhysicsModel:
    return PhysicsModel(
        KinematicBicycle("throttle"), [], {"base.wheelbase": Setting(0.3), "base.drive_gain": Setting(3.0)}
    )


def _rows(model: PhysicsModel, seconds: float, seed: int) -> list[list[float]]:
    draw = np.random.default_rng(seed)
    count = round(seconds / 0.05)
    steer = np.repeat(draw.uniform(-0.4, 0.4, count // 8 + 1), 8)
    throttle = np.repeat(draw.uniform(-0.6, 1.0, count // 12 + 1), 12)
    state, rows = np.array([0.0, 0.0, 0.0, 1.0]), []
    memory = model.initial_memory(np.array([throttle[0], steer[0]]))
    for row in range(count):
        action = np.array([np.clip(throttle[row] + 0.3 * (1.5 - state[3]), -1.0, 1.0), steer[row]])
        rows.append([0.05 * row, *(state + NOISE * draw.normal(size=4)), *action])
        state, memory = model.advance(state, action, memory, period=0.05, time=0.05 * row)
    return rows


def _written(path: Path, rows: list[list[float]], columns: tuple[str, ...] = COLUMNS) -> Path:
    with path.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([columns, *rows])
    return path


@pytest.fixture(scope="session")
def finished() -> Iterator[Callable[[Coroutine[Any, Any, Any]], Any]]:
    """Runs a coroutine to its end, on a thread of its own: the browser's tests leave a running loop in this one."""
    with ThreadPoolExecutor(1) as pool:
        yield lambda story: pool.submit(asyncio.run, story).result(90.0)


@pytest.fixture(scope="session")
def plain() -> PhysicsModel:
    """A car with throttle and no effect."""
    return _plain()


@pytest.fixture(scope="session")
def drives(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Path]]:
    """A model file, and two recordings of a car with quadratic drag that the model does not have."""
    folder = tmp_path_factory.mktemp("drives")
    truth = _plain().with_effect(effect("car", "quadratic_drag"), {"coefficient": Setting(0.3)})
    save_model(_plain(), folder / "plain.toml")
    runs = [_written(folder / f"drive_{seed}.csv", _rows(truth, 40.0, seed)) for seed in (1, 2)]
    return folder / "plain.toml", runs


@pytest.fixture(scope="session")
def complete_drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording that the model without any effect explains."""
    return _written(tmp_path_factory.mktemp("complete") / "complete.csv", _rows(_plain(), 60.0, 3))


@pytest.fixture(scope="session")
def runs(drives: tuple[Path, list[Path]], plain: PhysicsModel) -> list[Run]:
    """The recordings with the hidden drag."""
    return [load_run(path, plain.system) for path in drives[1]]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Headless Chromium; skips where there is none. Ends with its file: while it lives, no other loop runs here."""
    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if chromium is None:
        pytest.skip("no Chromium; install it (Debian: apt-get install chromium)")
    playwright = pytest.importorskip("playwright.sync_api", reason="no playwright; pip install playwright")
    with playwright.sync_playwright() as play:
        started = play.chromium.launch(
            executable_path=chromium, args=["--no-sandbox", "--disable-background-networking"]
        )
        yield started
        started.close()


def pytest_configure(config: pytest.Config) -> None:
    """The marker of tests that need Chromium."""
    config.addinivalue_line("markers", "browser: opens the page in a headless browser")
