"""The marker of the tests that start containers."""

from __future__ import annotations

import pytest


def pytest_configure(config: pytest.Config) -> None:
    """Registers the marker of this folder."""
    config.addinivalue_line("markers", "containers: builds images and starts containers; skips where docker is absent")
