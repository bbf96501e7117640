"""What a step consumed, written into what it computed: a recording then says which inputs a decision had."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from safedpa.bus.messages import ComputedMessage, Message, StateMessage
from safedpa.bus.node import Inputs, Outputs, Stale
from safedpa.bus.topics import Topic

__all__ = ["Trace", "consumed"]

_NEVER = -1.0


@dataclass(frozen=True, slots=True)
class Trace:
    """The fields of ``ComputedMessage`` for the outputs of one step."""

    step: int = 0
    consumed: tuple[tuple[float, ...], ...] = ()
    skipped: tuple[float, ...] = ()

    def on(self, outputs: Outputs) -> Outputs:
        """The outputs with the trace in those that carry one."""
        return {topic: self._in(message) for topic, message in outputs.items()}

    def _in(self, message: Message) -> Message:
        if not isinstance(message, ComputedMessage):
            return message
        return replace(message, step=self.step, consumed=self.consumed, skipped=self.skipped)


def consumed(topics: Sequence[Topic], inputs: Inputs, state: StateMessage) -> tuple[tuple[float, ...], ...]:
    """(inputs, 2): age in ticks and publish time of each input as ``ComputedMessage.consumed`` has them."""
    return tuple(_row(inputs[topic], state) for topic in topics)


def _row(item: Message | Stale, state: StateMessage) -> tuple[float, float]:
    if isinstance(item, Stale):
        return (_NEVER if item.age_ticks is None else float(item.age_ticks), 0.0)
    return float(state.tick - item.tick), item.publish_time
