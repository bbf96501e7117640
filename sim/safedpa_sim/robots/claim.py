"""Claims a robot name on the bus and checks that no other robot uses it."""

from __future__ import annotations

import time
import uuid
from collections.abc import Callable, Sequence

from safedpa.bus import STATE, Bus
from safedpa.errors import BusError

_SETTLE_SECONDS = 0.5
"""Time for discovery: peers that joined through a third one see each other after some 10 ms, seldom after 200."""
_LOOK_SECONDS = 0.1
"""A robot publishes its state at least this often in lockstep, and more often in real time."""


def claim_name(bus: Bus, name: str, clock: Callable[[], float] = time.monotonic) -> None:
    """Claims the robot ``name`` and returns when no other robot has it.

    Raises BusError when another robot claimed the name earlier, or publishes states under it.
    """
    claim_names(bus, (name,), clock)


def claim_names(
    bus: Bus, names: Sequence[str], clock: Callable[[], float] = time.monotonic, listener: Bus | None = None
) -> None:
    """Claims several names of one process at once, as ``claim_name`` does for each, in the time of one.

    ``listener`` receives the states of other robots; by default it is ``bus``, which then stays subscribed to them.
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
                    f"robot '{name}' of fleet '{bus.fleet}' is already running"
                    f"{f' (instance {earlier[0]})' if earlier else ''}; choose another --name, or end the other one "
                    "first"
                )


def _perhaps_taken(bus: Bus, names: Sequence[str], instance: str, speaking: set[str]) -> Sequence[str]:
    """Returns the names to check: all if an older robot of another process exists, otherwise those that publish."""
    if len(names) == 1 or any(other < instance for other in bus.instances("*", "robot")):
        return names
    return [name for name in names if name in speaking]
