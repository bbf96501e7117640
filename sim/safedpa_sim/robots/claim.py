"""Making sure that no other robot lives under a name before driving under it."""

from __future__ import annotations

import time
import uuid
from collections.abc import Callable, Sequence

from safedpa.bus import STATE, Bus
from safedpa.errors import BusError

__all__ = ["claim_name", "claim_names"]

_SETTLE_SECONDS = 0.5
"""Two peers that joined through a third one hear of each other a few tens of milliseconds later, seldom 200."""
_LOOK_SECONDS = 0.1
"""A robot repeats its state at least so often in lockstep, and ticks faster in real time."""


def claim_name(bus: Bus, name: str, clock: Callable[[], float] = time.monotonic) -> None:
    """Announces the robot ``name``; returns when it is the only one of that name.

    Raises BusError when another one is announced that started earlier, or when one is heard to speak.
    """
    claim_names(bus, (name,), clock)


def claim_names(
    bus: Bus, names: Sequence[str], clock: Callable[[], float] = time.monotonic, listener: Bus | None = None
) -> None:
    """Announces several robots of one process at once; as ``claim_name`` for each, in the time that one takes.

    ``listener`` hears whether another one speaks, the bus itself where it is None: what it subscribed to stays.
    """
    instance = f"{time.time_ns():016x}-{uuid.uuid4().hex[:8]}"
    inbox = (listener or bus).inbox((STATE,), names[0] if len(names) == 1 else "*", alone=True)
    for name in names:
        bus.claim(name, "robot", instance)
    end = clock() + _SETTLE_SECONDS
    while clock() < end:
        speaking = {item.robot for item in inbox.take(_LOOK_SECONDS)}
        for name in _perhaps_taken(bus, names, instance, speaking):
            earlier = [other for other in bus.instances(name, "robot") if other < instance]
            if name in speaking or earlier:
                raise BusError(
                    f"robot '{name}' of fleet '{bus.fleet}' lives already"
                    f"{f' (instance {earlier[0]})' if earlier else ''}; choose another --name, or end the other one "
                    "first"
                )


def _perhaps_taken(bus: Bus, names: Sequence[str], instance: str, speaking: set[str]) -> Sequence[str]:
    """The names to look at: all where robots of other processes live that are older, else those that speak."""
    if len(names) == 1 or any(other < instance for other in bus.instances("*", "robot")):
        return names
    return [name for name in names if name in speaking]
