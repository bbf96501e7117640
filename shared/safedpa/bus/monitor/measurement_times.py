"""When a received message was measured, by the receiver's clock.

A message may wait in a link or a queue, so its time of arrival is not that of its measurement. With the offset between
the receiver's clock and the publish times of one robot,

    offset = min over messages of (arrival - publish_time),      measured = publish_time + offset <= arrival,

the clocks of the two machines need not agree. A message about a tick (a verdict, a latent) is as old as the state from
which it was computed.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import Final, final

from safedpa.bus.messages.messages import Message, StateMessage

# Clocks of two machines drift apart by less than 200 ppm; the smallest difference ever seen would become too small.
_DRIFT: Final = 2e-4
# Verdicts follow their state within a few ticks.
_RETAINED_TICKS: Final = 256


@final
class MeasurementTimes:
    """Times of measurement of one robot's messages; call ``of`` once for each message, in the order of arrival."""

    def __init__(self) -> None:
        self._offset: float | None = None
        self._last: tuple[int, float, float] = (-1, 0.0, 0.0)
        """Epoch, publish time and arrival of the newest state."""
        self._ticks: OrderedDict[tuple[int, int], float] = OrderedDict()

    def of(self, message: Message, at: float) -> float:
        """Returns when the message that arrived at ``at`` was measured [s by the receiver's clock]; at most ``at``."""
        if isinstance(message, StateMessage):
            return self._of_state(message, at)
        return min(at, self._ticks.get((message.epoch, message.tick), at))

    def _of_state(self, message: StateMessage, at: float) -> float:
        key = (message.epoch, message.tick)
        # In lockstep the robot waits for an action and repeats its state, which is still the present.
        if message.lockstep:
            return self._keep(key, at)
        if key in self._ticks:
            return self._ticks[key]
        epoch, published, arrived = self._last
        difference = at - message.publish_time
        # A publish time that does not advance is no clock (or it was set back): only the arrival is known then.
        known = self._offset is not None and epoch == message.epoch and message.publish_time > published
        offset = min(difference, (self._offset or 0.0) + _DRIFT * (at - arrived)) if known else difference
        self._offset, self._last = offset, (message.epoch, message.publish_time, at)
        return self._keep(key, min(at, message.publish_time + offset))

    def _keep(self, key: tuple[int, int], measured: float) -> float:
        self._ticks[key] = measured
        if len(self._ticks) > _RETAINED_TICKS:
            self._ticks.popitem(last=False)
        return measured
