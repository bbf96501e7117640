"""From the transport into an inbox: what is asked for of one topic, alone or out of a bundle."""

from __future__ import annotations

from collections.abc import Callable
from typing import final

from safedpa.bus.transport.bundle import unbundled
from safedpa.bus.transport.inbox import Inbox, Parcel
from safedpa.bus.wire.topics import BUNDLE, Topic, key_of
from safedpa.errors import InputError, MessageError

__all__ = ["Intake"]


@final
class Intake:
    """Called by a transport with key and payload; puts what is asked for into ``inbox``.

    Of robots for whose name ``serves`` is false nothing gets in; ``wanted`` is the robot asked for, or ``*``;
    ``all_of_them``: nothing is dropped.
    """

    def __init__(
        self,
        inbox: Inbox,
        topic: Topic,
        fleet: str,
        wanted: str,
        serves: Callable[[str], bool] | None,
        *,
        all_of_them: bool,
    ) -> None:
        self._inbox, self._topic, self._fleet, self._all_of_them = inbox, topic, fleet, all_of_them
        self._wanted, self._serves = wanted, serves
        self._begins = len(f"safedpa/{fleet}/")
        self._bundles = f"safedpa/{fleet}/{BUNDLE}/{topic.name}"

    def __call__(self, key: str, payload: bytes) -> None:
        """Accepts what came under ``key``."""
        parcels = self.opened(key, payload)
        if parcels:
            self.put(parcels)
            self.announce()

    def opened(self, key: str, payload: bytes) -> list[Parcel]:
        """What came under ``key``, as far as it is asked for: alone, or each message of a bundle by itself."""
        if key.startswith(self._bundles) and "*" not in key:
            try:
                return self._parcels(key, payload)
            except InputError:
                return [Parcel(key, payload)]  # is refused where it is read, since its key names no robot
        served = self._serves is None or self._serves(key[self._begins :].partition("/")[0])
        return [Parcel(key, payload)] if served else []

    def put(self, parcels: list[Parcel]) -> None:
        """Into the inbox; parcels may be shared with others where ``asks_as`` is true, and ``announce`` follows."""
        self._inbox.add_parcels(parcels, all_of_them=self._all_of_them)

    def announce(self) -> None:
        """What was put there may be acted upon."""
        self._inbox.announce()

    def asks_as(self, other: Intake) -> bool:
        """Whether it asks for the same as ``other``, so that what one of them opened is right for both."""
        return (self._topic, self._fleet, self._wanted, self._serves) == (
            other._topic,
            other._fleet,
            other._wanted,
            other._serves,
        )

    def _parcels(self, key: str, payload: bytes) -> list[Parcel]:
        """Each message of a bundle that is asked for. Raises InputError where it is no bundle."""
        topic, fleet, wanted, serves = self._topic, self._fleet, self._wanted, self._serves
        service = key.rsplit("/", 1)[1] if topic.per_service else ""
        if len(payload) > topic.largest_bytes or key != key_of(fleet, BUNDLE, topic, service):
            raise MessageError(f"key '{key}': got {len(payload)} bytes, wanted a bundle of {topic.name}")
        entries = unbundled(payload)
        if wanted != "*":
            entries = [entry for entry in entries if entry[0] == wanted]
        if serves is not None:
            entries = [entry for entry in entries if serves(entry[0])]
        return [Parcel(key_of(fleet, robot, topic, service), message, bundled=True) for robot, message in entries]
