"""Making sure that no other robot lives under a name before driving under it."""

from __future__ import annotations

import time
import uuid
from collections.abc import Callable

from safedpa.bus import STATE, Bus
from safedpa.errors import BusError

__all__ = ["claim_name"]

_SETTLE_SECONDS = 0.5
"""Two peers that joined through a third one hear of each other a few tens of milliseconds later, seldom 200."""
_LOOK_SECONDS = 0.1
"""A robot repeats its state at least so often in lockstep, and ticks faster in real time."""


def claim_name(bus: Bus, name: str, clock: Callable[[], float] = time.monotonic) -> None:
    """Announces the robot ``name``; returns when it is the only one of that name.

    Raises BusError when another one is announced that started earlier, or when one is heard to speak.
    """
    instance = f"{time.time_ns():016x}-{uuid.uuid4().hex[:8]}"
    inbox = bus.inbox((STATE,), name)
    bus.claim(name, "robot", instance)
    end = clock() + _SETTLE_SECONDS
    while clock() < end:
        heard = inbox.take(_LOOK_SECONDS)
        earlier = [other for other in bus.instances(name, "robot") if other < instance]
        if heard or earlier:
            raise BusError(
                f"robot '{name}' of fleet '{bus.fleet}' lives already"
                f"{f' (instance {earlier[0]})' if earlier else ''}; choose another --name, or end the other one first"
            )
