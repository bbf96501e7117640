"""Offers of models by a process that has the key of a diagnosis."""

from collections.abc import Callable

import pytest
from tests.bus.fleet import stamp

from safedpa.bus import ModelMessage, ZenohSettings


@pytest.fixture
def offer_of() -> Callable[..., ModelMessage]:
    """``offer_of(document, fingerprint, change, margin)``."""

    def made(document: str, fingerprint: str = "0123456789ab", change: int = 1, margin: str = "") -> ModelMessage:
        return ModelMessage(
            **stamp(epoch=1), step="offer", change=change, fingerprint=fingerprint, replaces="", document=document,
            margin=margin,
        )  # fmt: skip

    return made


@pytest.fixture
def links_outlive(monkeypatch: pytest.MonkeyPatch) -> None:
    """Signs of life of sessions in this process may wait for longer than between robots: a busy machine parts none."""
    usual = ZenohSettings.configuration
    longer = {"transport/link/tx/lease": 30_000}
    monkeypatch.setattr(ZenohSettings, "configuration", lambda settings: usual(settings) | longer)


def pytest_configure(config: pytest.Config) -> None:
    """The marker of tests that need Chromium."""
    config.addinivalue_line("markers", "browser: opens the page in a headless browser")
