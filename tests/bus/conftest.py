"""One message of every kind, and a bus in memory."""

import dataclasses
import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from safedpa.bus import Bus, MemoryBroker, MemoryTransport, Message, StateMessage, ZenohSettings

SAMPLES = Path(__file__).parent / "samples"


def _load_samples() -> dict[str, Message]:
    specification = importlib.util.spec_from_file_location("bus_samples", SAMPLES / "write_samples.py")
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    found: dict[str, Message] = module.SAMPLES
    return found


@pytest.fixture(autouse=True)
def _links_outlive_a_busy_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    """Signs of life may take longer than between robots: with a lost link the messages on it are lost."""
    usual = ZenohSettings.configuration
    longer = {"transport/link/tx/lease": 30_000}
    monkeypatch.setattr(ZenohSettings, "configuration", lambda settings: usual(settings) | longer)


@pytest.fixture(scope="session")
def samples() -> dict[str, Message]:
    """One message of every topic, by the topic's name, with no field at its default."""
    return _load_samples()


@pytest.fixture
def state_at(samples: dict[str, Message]) -> Callable[..., StateMessage]:
    """``state_at(tick, **changes)``: a state message."""

    def made(tick: int = 0, **changes: Any) -> StateMessage:
        state = samples["state"]
        assert isinstance(state, StateMessage)
        return dataclasses.replace(state, tick=tick, **changes)

    return made


@pytest.fixture
def broker() -> MemoryBroker:
    """What the buses of one test share."""
    return MemoryBroker()


@pytest.fixture
def memory_bus(broker: MemoryBroker) -> Callable[[], Bus]:
    """Makes one more participant of the fleet ``test``."""
    return lambda: Bus(MemoryTransport(broker), "test")
