"""A recording through the real nodes: does every latent, nominal action, action and verdict come out again?"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from safedpa.bus import (
    ACTION,
    LATENT,
    NOMINAL,
    SURROUNDINGS,
    VERDICT,
    ActionMessage,
    Message,
    StateMessage,
    SurroundingsMessage,
    Topic,
    VerdictMessage,
)
from safedpa.perception import PerceptionNode
from safedpa.replay.comparison import TOLERANCE, Difference, differences
from safedpa.replay.driver import Driver, ReplayedStep
from safedpa.replay.setups import REPLAYED, node_of
from safedpa.replay.tape import RobotTape

__all__ = ["Replay", "ServiceReplay", "UnknownStateSpan", "replay"]

_AGREED = 20
"""Outputs in a row that agree, after which a memory that was not known counts as known again."""

_STATISTICS = frozenset({"coverage"})
"""Shares of the last 500 steps: where some of these were unknown they tell another number, and decide nothing."""
_TOPICS = {PerceptionNode.name: SURROUNDINGS, "adaptation": LATENT, "policy": NOMINAL, "safety_filter": VERDICT}
"""What each service computes."""


@dataclass
class UnknownStateSpan:
    """Steps whose memory was not known, because something was not recorded.

    It reaches to the last output that came out otherwise before the memory began again: what differs behind a gap may
    stem from the gap, and is no difference that can be compared with the service.
    """

    reason: str
    epoch: int
    tick: int
    robot_time: float
    agrees_from: int | None = None
    """Tick from which on all came out as recorded again; None: it did not until the end of the span."""
    again_from: int | None = None
    """Tick at which the memory began again, and was known again; None: at none."""
    steps: int = 0
    """Not compared."""


@dataclass
class ServiceReplay:
    """What became of one service's outputs."""

    service: str
    compared: dict[str, int] = field(default_factory=dict)
    """Messages by topic."""
    identical: dict[str, int] = field(default_factory=dict)
    """Of these, the ones in which every field is the same bit for bit."""
    differing: list[Difference] = field(default_factory=list)
    """Beyond the tolerance."""
    rounded: int = 0
    """Fields that differ within the tolerance."""
    spans: list[UnknownStateSpan] = field(default_factory=list)
    lost: int = 0
    """Outputs that are not in the recording, and were made up to know the memory."""


@dataclass
class Replay:
    """The whole, service by service."""

    services: list[ServiceReplay]

    @property
    def agrees(self) -> bool:
        """Whether everything that can be compared came out as recorded, and nothing stayed unknown to the end."""
        return self.unsettled is None and not any(part.differing for part in self.services)

    @property
    def unsettled(self) -> UnknownStateSpan | None:
        """A span that reaches to the end of the recording; None: there is none."""
        last = [part.spans[-1] for part in self.services if part.spans]
        return next((span for span in last if span.agrees_from is None and span.again_from is None), None)

    @property
    def exact(self) -> bool:
        """Whether it did so bit for bit."""
        return self.agrees and not any(part.rounded for part in self.services)


def replay(
    tape: RobotTape,
    window: tuple[float, float] = (float("-inf"), float("inf")),
    tolerance: float = TOLERANCE,
    folders: tuple[Path, ...] = (),
    report_progress: Callable[[ReplayedStep], None] = lambda _: None,
) -> Replay:
    """Replays every service with a setup and outputs; compares what has a robot time in ``window`` [s].

    The steps before the window are replayed as well: they make the memory. ``report_progress`` hears of every step. Raises
    InputError when a setup is broken or a learned model's weights are not to be found.
    """
    found = []
    made_up: dict[tuple[Topic, int, int], Message] = {}
    for service in (*((PerceptionNode.name,) if _reported_of_scans(tape) else ()), *REPLAYED):
        if tape.computed[service] and tape.setups.get(service):
            steps = Driver(tape, service, lambda setup: node_of(setup, folders), made_up=made_up).run()
            found.append(_OutputComparison(tape, service, window, tolerance).judged(steps, report_progress))
    return Replay(found)


def _reported_of_scans(tape: RobotTape) -> bool:
    """Whether perception told which scans it had heard; what older programs made of them is believed."""
    return "scans" in tape.fields.get(SurroundingsMessage, frozenset())


_Judged = list[tuple[Topic, list[Difference]]]
"""The differences of one step's messages, within the tolerance or not."""


class _OutputComparison:
    """Holds the steps of one service against the recording."""

    def __init__(self, tape: RobotTape, service: str, window: tuple[float, float], tolerance: float) -> None:
        self._tape, self._window, self._tolerance = tape, window, tolerance
        self._found = ServiceReplay(service)
        self._span: UnknownStateSpan | None = None
        self._agreeing: list[tuple[StateMessage, _Judged]] = []
        """Within a span: since the last output that came out otherwise."""

    def judged(self, steps: Iterator[ReplayedStep], report_progress: Callable[[ReplayedStep], None]) -> ServiceReplay:
        for step in steps:
            report_progress(step)
            if step.again or step.unknown:
                self._close(step.state.tick if step.again else None)
            if step.unknown:
                state = step.state
                self._span = UnknownStateSpan(step.unknown, state.epoch, state.tick, state.robot_time)
                self._found.spans.append(self._span)
            if step.recorded is None:
                self._found.lost += 1
            else:
                self._judge(step)
        self._close()
        return self._found

    def _judge(self, step: ReplayedStep) -> None:
        found = [(topic, self._differences(topic, one, other)) for topic, one, other in self._pairs(step)]
        if self._span is None:
            self._count(step.state, found)
        elif any(not item.exact_only for _, items in found for item in items):
            self._span.steps += len(self._agreeing) + 1
            self._agreeing.clear()
        else:
            self._agreeing.append((step.state, found))

    def _close(self, again_from: int | None = None) -> None:
        """Ends the span: what agreed behind its last difference counts, if it is more than chance."""
        if self._span is None:
            return
        self._span.again_from = again_from
        if len(self._agreeing) >= _AGREED:
            self._span.agrees_from = self._agreeing[0][0].tick
            for state, found in self._agreeing:
                self._count(state, found)
        else:
            self._span.steps += len(self._agreeing)
        self._span = None
        self._agreeing.clear()

    def _count(self, state: StateMessage, judged: _Judged) -> None:
        if not self._window[0] <= state.robot_time <= self._window[1]:
            return
        found = self._found
        for topic, items in judged:
            found.compared[topic.name] = found.compared.get(topic.name, 0) + 1
            found.identical[topic.name] = found.identical.get(topic.name, 0) + (not items)
            found.differing += [item for item in items if not item.exact_only]
            found.rounded += sum(item.exact_only for item in items)

    def _differences(self, topic: Topic, recorded: Message, replayed: Message | None) -> list[Difference]:
        if replayed is None:
            stamp = (recorded.epoch, recorded.tick, recorded.robot_time)
            return [Difference(*stamp, topic.name, "message", "sent", "none", exact_only=False)]
        reported = self._tape.fields[topic.message] - (_STATISTICS if self._found.spans else frozenset())
        return list(differences(topic.name, recorded, replayed, reported, self._tolerance))

    def _pairs(self, step: ReplayedStep) -> Iterator[tuple[Topic, Message, Message | None]]:
        """Topic, recorded and replayed message of a step; the action belongs to its verdict."""
        recorded = step.recorded
        topic = _TOPICS[self._found.service]
        assert recorded is not None
        yield topic, recorded, step.outputs.get(topic)
        if isinstance(recorded, VerdictMessage):
            action = self._action(recorded)
            if action is not None:
                yield ACTION, action, step.outputs.get(ACTION)

    def _action(self, verdict: VerdictMessage) -> ActionMessage | None:
        """The recorded action to which a verdict belongs; of two processes that answered a tick, the right one's."""
        known = self._tape.actions.get((verdict.epoch, verdict.tick), [])
        return next((action for action in known if action.values == verdict.action), known[0] if known else None)
