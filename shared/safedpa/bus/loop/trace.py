"""What a step consumed, written into what it computed: a recording then says which inputs a decision had."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from safedpa.bus.loop.node import Inputs, Outputs, Stale
from safedpa.bus.wire.messages import ComputedMessage, StateMessage
from safedpa.bus.wire.topics import Topic

__all__ = ["Trace", "consumed"]

_NEVER = -1.0
_write = object.__setattr__


class Trace(NamedTuple):
    """The fields of ``ComputedMessage`` for the outputs of one step."""

    step: int = 0
    consumed: tuple[tuple[float, ...], ...] = ()
    skipped: tuple[float, ...] = ()

    def on(self, outputs: Outputs) -> Outputs:
        """The outputs, with the trace written into those that carry one.

        In place: the node made these messages for this step, and nobody has them yet. A copy of each would cost more
        than everything else that the loop does between the step and its sending.
        """
        for message in outputs.values():
            if isinstance(message, ComputedMessage):
                _write(message, "step", self.step)
                if self.consumed:
                    _write(message, "consumed", self.consumed)
                if self.skipped:
                    _write(message, "skipped", self.skipped)
        return outputs


def consumed(topics: Sequence[Topic], inputs: Inputs, state: StateMessage) -> tuple[tuple[float, ...], ...]:
    """(inputs, 2): age in ticks and publish time of each input as ``ComputedMessage.consumed`` has them."""
    rows = []
    for topic in topics:
        item = inputs[topic]
        if isinstance(item, Stale):
            rows.append((_NEVER if item.age_ticks is None else float(item.age_ticks), 0.0))
        else:
            rows.append((float(state.tick - item.tick), item.publish_time))
    return tuple(rows)
