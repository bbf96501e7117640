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


def claim_names(bus: Bus, names: Sequence[str], clock: Callable[[], float] = time.monotonic) -> None:
    """Announces several robots of one process at once; as ``claim_name`` for each, in the time that one takes."""
    instance = f"{time.time_ns():016x}-{uuid.uuid4().hex[:8]}"
    inboxes = {name: bus.inbox((STATE,), name) for name in names}
    for name in names:
        bus.claim(name, "robot", instance)
    end = clock() + _SETTLE_SECONDS
    while clock() < end:
        for position, (name, inbox) in enumerate(inboxes.items()):
            heard = inbox.take(_LOOK_SECONDS if position == 0 else 0.0)
            earlier = [other for other in bus.instances(name, "robot") if other < instance]
            if heard or earlier:
                raise BusError(
                    f"robot '{name}' of fleet '{bus.fleet}' lives already"
                    f"{f' (instance {earlier[0]})' if earlier else ''}; choose another --name, or end the other one "
                    "first"
                )
