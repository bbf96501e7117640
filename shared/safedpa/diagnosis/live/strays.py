"""Services that use another model than the one agreed on, as their health tells."""

from __future__ import annotations

from typing import final

from safedpa.bus import HealthMessage, StateMessage
from safedpa.diagnosis.live.under_way import SERVICES

__all__ = ["Strays"]

_SETTLE_TICKS = 10
"""After the tick of a change, before a service that says to use another model is believed."""
_FIRST_PAUSE = 200
"""Ticks after a repair that came to nothing; doubled each time."""
_LONGEST_PAUSE = 72000
"""Ticks: an hour at 20 Hz."""


@final
class Strays:
    """Keeps the newest health of every service, and how long to wait after a repair that failed."""

    def __init__(self) -> None:
        self._health: dict[str, HealthMessage] = {}
        self._since: tuple[int, int] | None = None
        self._ticks = 0
        self._again_at, self._pause = 0, _FIRST_PAUSE

    def hear(self, message: HealthMessage) -> None:
        """Takes what a service says of itself."""
        if message.service in SERVICES:
            self._health[message.service] = message

    def settle(self, state: StateMessage, *, anew: bool) -> None:
        """Once per tick; ``anew`` from the tick on at which another version is in force."""
        if self._since is None or self._since[0] != state.epoch or anew:
            self._since = (state.epoch, state.tick)
        self._ticks += not anew

    def found(self, fingerprint: str) -> str:
        """Who uses another model than the one in force, in words; empty: nobody, or it is too early to say."""
        if self._since is None or self._ticks < self._again_at:
            return ""
        epoch, tick = self._since
        strays = {
            name: health.model
            for name, health in self._health.items()
            if health.epoch == epoch and health.tick >= tick + _SETTLE_TICKS and health.model not in ("", fingerprint)
        }
        if strays:
            self._health = {}
        return ", ".join(f"{name} uses {model}" for name, model in sorted(strays.items()))

    def mended(self) -> None:
        """A change was taken by everyone."""
        self._pause = _FIRST_PAUSE

    def not_mended(self) -> None:
        """A repair came to nothing: the next one waits."""
        self._again_at = self._ticks + self._pause
        self._pause = min(2 * self._pause, _LONGEST_PAUSE)
