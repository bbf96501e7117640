"""What all tests share: the hypothesis profiles, the folder of real measurements, free ports."""

import gc
import os
import re
import signal
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

# Before numpy is imported: threads that wait for each other over matrices of a few rows take ten times as long.
os.environ["OMP_NUM_THREADS"] = os.environ["OPENBLAS_NUM_THREADS"] = os.environ["MKL_NUM_THREADS"] = "1"

# What a developer's shell may say of every Python process: with it a flush that is forgotten is missed by no one.
os.environ.pop("PYTHONUNBUFFERED", None)

import numpy as np
import pytest
from hypothesis import HealthCheck, settings

from safedpa.bus import logging
from safedpa.bus.transport import ports
from safedpa.dynamics import base as bases
from safedpa.effects import library
from safedpa.networks import Description, EnvironmentEntry, Weights
from safedpa.systems import registry
from safedpa.systems import robots as declared

_REPOSITORY = Path(__file__).resolve().parents[1]

TRAINING = ("training", "point", "lab/training", "lab/benchmarks", "lab/point", "lab/pendulum")
TRAINING += ("lab/theory/test_theory_command.py", "effects/test_every_effect.py", "safety/test_environment_chain.py")
"""Folders and files in ``tests`` that load torch and what stands on it: 400 MB that one process alone need carry."""
LIGHT = ("adaptation", "bus", "bus_security", "dynamics", "effects", "fleet_process", "networks", "operations")
LIGHT += ("policy", "replay", "robots", "safety", "sensing")
"""Folders that load little: where trainings are over, their process is given these before what loads readers and
viewers; everybody else ends with them, since they are short."""
WAITING = ("pytest.mark.processes", "pytest.mark.browser")
"""Marks in files of tests that mostly wait, for processes that drive in real time or for a browser: one process has
these, so that the cores are busy with the tests of the others meanwhile."""

settings.register_profile("ci", derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("search", deadline=None, max_examples=500, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "ci"))


def pytest_configure(config: pytest.Config) -> None:
    """xdist would begin with the files of most tests, and end with one core on a file of one long test.

    What a script starts in the background ignores interrupts, and so would every process that a test starts: one that
    is to end by an interrupt were waited for until patience ends.
    """
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if hasattr(config.option, "loadscopereorder"):
        config.option.loadscopereorder = False
    gc.disable()  # what is collected stays to the end: looking through it for garbage is a fifth of the collection


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """File by file; one process gets the files that load torch, so that the others stay small; one those that wait."""
    if config.getvalue("dist") != "loadfile":
        return None
    from xdist.scheduler import LoadFileScheduling

    class ByLibraries(LoadFileScheduling):
        def _assign_work_unit(self, node: Any) -> None:
            order = ("", "light", "waiting", "training")
            if node is self.nodes[0]:
                order = ("training", "light", "", "waiting")
            elif node is self.nodes[-1] and len(self.nodes) > 2:
                order = ("waiting", "", "light", "training")
            self.workqueue.move_to_end(min(self.workqueue, key=lambda file: order.index(kind_of(file))), last=False)
            super()._assign_work_unit(node)

    return ByLibraries(config, log)


@cache
def kind_of(file: str) -> str:
    """``training``, ``waiting``, ``light`` or none of these: of a file of tests, from the root."""
    inside = file.removeprefix("tests/")
    if inside.startswith(tuple(name if name.endswith(".py") else f"{name}/" for name in TRAINING)):
        return "training"
    if any(mark in _text_of(_REPOSITORY / file) for mark in WAITING):
        return "waiting"
    return "light" if inside.startswith(tuple(f"{name}/" for name in LIGHT)) else ""


def _text_of(file: Path) -> str:
    return file.read_text(encoding="utf-8") if file.is_file() else ""


LONG = "pytest.mark.long"
_ALL_LONG = re.compile(r"^pytestmark = .*pytest\.mark\.long", re.MULTILINE)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Files of which ``make test`` or ``make test-long`` runs no test are not imported: every process collects."""
    asked = config.option.markexpr
    if asked not in ("long", "not long") or not collection_path.match("test_*.py"):
        return None
    text = _text_of(collection_path)
    foreign = LONG not in text if asked == "long" else bool(_ALL_LONG.search(text))
    return foreign or None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files with slow tests come first, so that all cores end at about the same time."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)
    if os.environ.get("HYPOTHESIS_PROFILE") == "search":
        for item in items:
            search_longer(item)


_TIMES = 10
"""Examples of a search, for each of those that a test of its own number has with every change."""


def search_longer(item: Any) -> None:
    """Where a test states its own number of examples, or the same ones each time, a search goes on all the same."""
    test = getattr(item, "obj", None)
    stated = getattr(test, "_hypothesis_internal_use_settings", None)
    if stated is not None:
        more = max(_TIMES * stated.max_examples, settings().max_examples)
        test._hypothesis_internal_use_settings = settings(stated, max_examples=more, derandomize=False)


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Says at once which test failed: a run that is broken off, or aborts, prints no summary."""
    if report.failed and "PYTEST_XDIST_WORKER" not in os.environ:
        crash = getattr(report.longrepr, "reprcrash", None)
        notice = str(getattr(crash, "message", report.longrepr)).strip().splitlines()[:1]
        print(f"\n{report.when} of {report.nodeid} failed: {(notice or [''])[0][:200]}", flush=True)


def pytest_collection_finish() -> None:
    """Modules and test items are nothing that a later search for garbage has to walk through."""
    gc.enable()
    gc.freeze()


@pytest.fixture(scope="session")
def repository() -> Path:
    """The root of the working tree."""
    return _REPOSITORY


@pytest.fixture(autouse=True, scope="session")
def _temporary_folder_of_this_run_alone(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Whatever programs and libraries leave in the temporary folder goes when the tests end.

    Its path is short: sockets lie in it, and the kernel takes 107 letters. Folders of tests are pytest's own to keep.
    """
    tmp_path_factory.getbasetemp()  # is chosen before, next to those of former runs
    with (
        tempfile.TemporaryDirectory(prefix="t-", ignore_cleanup_errors=True) as folder,
        pytest.MonkeyPatch.context() as patch,
    ):
        patch.setenv("TMPDIR", folder)
        patch.setattr(tempfile, "tempdir", folder)
        yield


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """The folder of real measurements; skips where there is none."""
    folder = Path(os.environ.get("SAFEDPA_DATA", _REPOSITORY.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no real measurements at {folder}; name their folder by SAFEDPA_DATA")
    return folder


@pytest.fixture
def free_port() -> int:
    """A TCP port on the loopback interface that was free a moment ago."""
    return ports.free_port()


@pytest.fixture(autouse=True)
def _process_as_it_was_found() -> Iterator[None]:
    """What a test, or a command that it runs, changes of the process is gone after it, in whatever order tests run.

    Higher fixtures were set up before, and keep what they changed until they end.
    """
    environment, folder = dict(os.environ), Path.cwd()
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    if os.environ != environment:
        os.environ.clear()
        os.environ.update(environment)
    os.chdir(folder)
    for number, handler in handlers.items():
        signal.signal(number, handler)


@pytest.fixture(autouse=True)
def _events_of_one_test_alone() -> Iterator[None]:
    """Of events that come together the later ones are reported a second after the first: not to the test that is
    next."""
    yield
    logging.EVENT_LOG.reset_rate_limits()


@pytest.fixture(autouse=True)
def _effects_of_one_test_alone(_process_as_it_was_found: None) -> Iterator[None]:
    """Robots, bases and effects that a test loads from a file of its own are gone after it."""
    with _nothing_left():
        yield


@pytest.fixture(autouse=True, scope="module")
def _effects_of_one_file_alone() -> Iterator[None]:
    """The same of what a fixture loads for all tests of a file."""
    with _nothing_left():
        yield


@pytest.fixture(autouse=True, scope="module")
def _memories_of_one_file_alone(request: pytest.FixtureRequest) -> Iterator[None]:
    """What a file's own functions remember (``cache``) goes with its last test: a thousand syntax trees take 190 MB."""
    yield
    for value in vars(request.module).values():
        if getattr(value, "__module__", "") == request.module.__name__ and hasattr(value, "cache_clear"):
            value.cache_clear()


@contextmanager
def _nothing_left() -> Iterator[None]:
    tables: tuple[dict[Any, Any], ...] = (
        library.REGISTERED,
        registry.REGISTERED,
        bases.REGISTERED,
        declared.REGISTERED,
    )
    before = [dict(table) for table in tables]
    yield
    for table, retained in zip(tables, before, strict=True):
        table.clear()
        table.update(retained)


@pytest.fixture(scope="session")
def random_car_weights() -> Callable[..., Weights]:
    """Makes weights for a car from (seed, latents, history, width, environment)."""
    return _random_car_weights


_TOWED = (EnvironmentEntry("towed_load.mass_ratio", 0.0, 1.5), EnvironmentEntry("towed_load.deceleration", 0.0, 4.0))


def _random_car_weights(
    seed: int = 0, latents: int = 4, history: int = 50, width: int = 16,
    environment: tuple[EnvironmentEntry, ...] = _TOWED,
) -> Weights:  # fmt: skip
    """Random networks for the car: they predict nonsense, smoothly, in the shapes and names of trained ones."""
    draw = np.random.default_rng(seed)
    tensors: dict[str, Any] = {}

    def dense(name: str, outputs: int, inputs: int) -> None:
        tensors[f"{name}.weight"] = draw.normal(0.0, 1.0 / np.sqrt(inputs), (outputs, inputs))
        tensors[f"{name}.bias"] = draw.normal(0.0, 0.1, outputs)

    for name, outputs in (("f", 4), ("g", 8)):
        for index, (out, into) in enumerate(((width, 3 + latents), (width, width), (outputs, width))):
            dense(f"{name}.{index}", out, into)
    if latents:
        low, high = (np.array([getattr(entry, name) for entry in environment]) for name in ("low", "high"))
        dense("mu.0", 64, len(environment))
        dense("mu.1", latents, 64)
        dense("phi.dense.0", 32, 9)
        dense("phi.dense.1", 32, 32)
        for index in range(2):
            tensors[f"phi.conv.{index}.weight"] = draw.normal(0.0, 0.06, (32, 32, 8))
            tensors[f"phi.conv.{index}.bias"] = draw.normal(0.0, 0.1, 32)
        dense("phi.out", latents, 32)
        tensors |= {"environment_middle": 0.5 * (low + high), "environment_scale": 0.5 * (high - low)}
        tensors |= {"latent_low": np.full(latents, -3.0), "latent_high": np.full(latents, 3.0)}
        tensors["latent_nominal"] = np.zeros(latents)
    tensors |= {
        "feature_middle": np.array([0.0, 0.0, 0.7]),
        "feature_scale": np.array([1.0, 1.0, 1.3]),
        "action_middle": np.array([0.7, 0.0]),
        "action_scale": np.array([1.3, 0.34]),
        "increment_scale": np.array([0.1, 0.02, 0.1, 0.2]),
    }
    description = Description(
        robot="car",
        period=0.05,
        states=("x", "y", "yaw", "speed"),
        actions=("target_speed", "steer"),
        latents=latents,
        history=history if latents else 0,
        environment=environment if latents else (),
        trained_on={"seed": seed},
    )
    return Weights({name: tensor.astype(np.float32) for name, tensor in tensors.items()}, description)
