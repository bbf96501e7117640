"""What all tests share: the hypothesis profiles, the folder of real measurements, free ports."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from safedpa.effects import library

_REPOSITORY = Path(__file__).resolve().parents[1]

settings.register_profile("ci", derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("search", deadline=None, max_examples=500)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "ci"))


@pytest.fixture(scope="session")
def repository() -> Path:
    """The root of the working tree."""
    return _REPOSITORY


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
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
    return port


@pytest.fixture(autouse=True)
def _effects_of_one_test_alone() -> Iterator[None]:
    """Effects that a test loads from a file of its own are gone after it."""
    before = dict(library._own)
    yield
    library._own.clear()
    library._own.update(before)
