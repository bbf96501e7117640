"""The health of the services of one robot: what they say of themselves, and their silence."""

from __future__ import annotations

from dataclasses import dataclass

from safedpa.bus import HealthMessage
from safedpa_services.dashboard.palette import HEALTH_COLOURS, SERIES
from safedpa_services.dashboard.shapes import Curves, Entry, States, StateSet

__all__ = ["HealthBook"]

SILENT_SECONDS = 1.0
"""Four heartbeats."""

_MOST_SERVICES = 16


@dataclass
class _Service:
    heard: float
    shown: str
    own: bool
    """Whether it spoke of this robot, not of the fleet alone."""


class HealthBook:
    """States as they change, step times at each heartbeat; ``now`` [s] is the dashboard's monotonic clock."""

    def __init__(self) -> None:
        self._services: dict[str, _Service] = {}

    def add(self, message: HealthMessage, now: float, *, own: bool = True) -> list[Entry]:
        """Entries of one heartbeat; ``own`` False: of a service of the whole fleet, until it speaks of this robot."""
        name = message.service or "unnamed"
        entries: list[Entry] = []
        if name not in self._services:
            if len(self._services) >= _MOST_SERVICES:
                return []
            entries = _styles(name, len(self._services))
            self._services[name] = _Service(now, "", own)
        service = self._services[name]
        if service.own and not own:
            return []
        service.heard, service.own = now, own
        if 0.0 <= message.step_microseconds < 1e9:
            entries.append(Entry(("steps", name), Curves((1e-3 * message.step_microseconds,))))
        return [*entries, *_change(name, service, message.state)]

    @property
    def states(self) -> dict[str, str]:
        """The state of each service as it is shown."""
        return {name: service.shown for name, service in self._services.items()}

    def lanes(self) -> list[Entry]:
        """The lane of each service as it is now."""
        return [Entry(("services", name), States(state)) for name, state in self.states.items() if state]

    def silences(self, now: float) -> list[Entry]:
        """Entries of the services that fell silent since the last call."""
        late = [item for item in self._services.items() if now - item[1].heard > SILENT_SECONDS]
        return [entry for name, service in late for entry in _change(name, service, "silent")]


def _change(name: str, service: _Service, state: str) -> list[Entry]:
    if state == service.shown:
        return []
    service.shown = state
    return [Entry(("services", name), States(state))]


def _styles(name: str, index: int) -> list[Entry]:
    curve = Curves((), (name,), (SERIES[index % len(SERIES)],), (1.5,))
    return [
        Entry(("services", name), StateSet(HEALTH_COLOURS), static=True),
        Entry(("steps", name), curve, static=True),
    ]
