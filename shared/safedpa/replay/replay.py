"""Replays a recording through the real nodes and compares every latent, nominal action, action and verdict."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, fields
from math import isclose
from pathlib import Path
from typing import Any

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
from safedpa.replay.driver import Driver, ReplayedStep
from safedpa.replay.setups import REPLAYED, node_of
from safedpa.replay.tape import RobotTape

TOLERANCE = 1e-6
"""Numbers x agree if |difference| <= 1e-6 max(1, |x|).

On the machine and with the libraries of the recording, results are identical. On another processor numpy, BLAS and
the QP solver sum in another order: results differ by about 1e-12, and solutions by the solver's tolerance of 1e-9."""

_NOT_COMPARED = frozenset({"version", "publish_time", "microseconds", "step", "consumed", "skipped"})
"""Fields about time and inputs, which are not part of the decision."""
_NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e[+-]?\d+)?")


@dataclass(frozen=True, slots=True)
class Difference:
    """A field of a message whose replayed value differs from the recorded one."""

    epoch: int
    tick: int
    robot_time: float
    topic: str
    field: str
    recorded: Any
    replayed: Any
    exact_only: bool
    """Whether the difference is within the tolerance."""


def differences(
    topic: str, recorded: Message, replayed: Message, recorded_fields: frozenset[str], tolerance: float = TOLERANCE
) -> Iterator[Difference]:
    """Yields every field in which two messages differ; ``recorded_fields`` are the fields that the recording has."""
    for item in fields(recorded):
        if item.name in _NOT_COMPARED or item.name not in recorded_fields:
            continue
        one, other = getattr(recorded, item.name), getattr(replayed, item.name)
        if one == other:
            continue
        near = _near(one, other, tolerance)
        yield Difference(
            recorded.epoch, recorded.tick, recorded.robot_time, topic, item.name, one, other, exact_only=near
        )


def _near(one: Any, other: Any, tolerance: float) -> bool:
    """Whether two values agree within the tolerance; also compares numbers inside sentences."""
    if isinstance(one, tuple) and isinstance(other, tuple):
        return len(one) == len(other) and all(_near(a, b, tolerance) for a, b in zip(one, other, strict=True))
    if isinstance(one, str) and isinstance(other, str):
        return _NUMBER.sub("#", one) == _NUMBER.sub("#", other) and _near(_numbers(one), _numbers(other), tolerance)
    if isinstance(one, float) and isinstance(other, float):
        return isclose(one, other, rel_tol=tolerance, abs_tol=tolerance)
    return bool(one == other)


def _numbers(text: str) -> tuple[float, ...]:
    return tuple(float(found) for found in _NUMBER.findall(text))


_AGREEING_OUTPUTS = 20
"""Consecutive agreeing outputs after which an unknown memory counts as known again."""

_STATISTICS = frozenset({"coverage"})
"""Statistics of the last 500 steps. They differ if some of these steps were unknown, and affect no decision."""
_TOPICS = {PerceptionNode.name: SURROUNDINGS, "adaptation": LATENT, "policy": NOMINAL, "safety_filter": VERDICT}
"""Output that is compared for each service."""


@dataclass
class UnknownStateSpan:
    """Steps for which the memory of a service is unknown, because something was not recorded.

    The span ends after its last differing output, or where the memory restarts: a difference after a gap may be caused
    by the gap, and does not count against the service.
    """

    reason: str
    epoch: int
    tick: int
    robot_time: float
    agrees_from: int | None = None
    """Tick from which on all outputs agree again; None if they do not agree until the end of the span."""
    again_from: int | None = None
    """Tick at which the memory restarted and so was known again; None if it did not."""
    steps: int = 0
    """Number of steps that were not compared."""


@dataclass
class ServiceReplay:
    """Result of the comparison for one service."""

    service: str
    compared: dict[str, int] = field(default_factory=dict)
    """Number of compared messages, by topic."""
    identical: dict[str, int] = field(default_factory=dict)
    """Number of bitwise identical messages, by topic."""
    differing: list[Difference] = field(default_factory=list)
    """Differences beyond the tolerance."""
    rounded: int = 0
    """Number of fields that differ within the tolerance."""
    spans: list[UnknownStateSpan] = field(default_factory=list)
    lost: int = 0
    """Outputs that are not in the recording and were recomputed, to know the memory."""


@dataclass
class Replay:
    """Result of a replay, by service."""

    services: list[ServiceReplay]

    @property
    def agrees(self) -> bool:
        """Whether everything that can be compared agrees, and no memory stayed unknown to the end."""
        return self.unsettled is None and not any(part.differing for part in self.services)

    @property
    def unsettled(self) -> UnknownStateSpan | None:
        """A span that reaches to the end of the recording; None if there is none."""
        last = [part.spans[-1] for part in self.services if part.spans]
        return next((span for span in last if span.agrees_from is None and span.again_from is None), None)

    @property
    def exact(self) -> bool:
        """Whether everything is bitwise identical."""
        return self.agrees and not any(part.rounded for part in self.services)


def replay(
    tape: RobotTape,
    window: tuple[float, float] = (float("-inf"), float("inf")),
    tolerance: float = TOLERANCE,
    folders: tuple[Path, ...] = (),
    report_progress: Callable[[ReplayedStep], None] = lambda _: None,
) -> Replay:
    """Replays every service that has a setup and outputs; compares outputs with robot time in ``window`` [s].

    Steps before the window are replayed as well, because they determine the memory. ``report_progress`` is called with
    every step. Raises InputError if a setup is invalid or the weights of a learned model are not found.
    """
    found = []
    reconstructed: dict[tuple[Topic, int, int], Message] = {}
    # Without the scans that perception used, its outputs are accepted as recorded.
    scans_are_recorded = "scans" in tape.fields.get(SurroundingsMessage, frozenset())
    for service in (*((PerceptionNode.name,) if scans_are_recorded else ()), *REPLAYED):
        if tape.computed[service] and tape.setups.get(service):
            steps = Driver(tape, service, lambda setup: node_of(setup, folders), reconstructed=reconstructed).run()
            found.append(_OutputComparison(tape, service, window, tolerance).compare(steps, report_progress))
    return Replay(found)


_StepDifferences = list[tuple[Topic, list[Difference]]]
"""Differences of the messages of one step, also those within the tolerance."""


class _OutputComparison:
    """Compares the steps of one service with the recording."""

    def __init__(self, tape: RobotTape, service: str, window: tuple[float, float], tolerance: float) -> None:
        self._tape, self._window, self._tolerance = tape, window, tolerance
        self._result = ServiceReplay(service)
        self._span: UnknownStateSpan | None = None
        self._agreeing: list[tuple[StateMessage, _StepDifferences]] = []
        """Within an unknown span: the steps since the last differing output."""

    def compare(self, steps: Iterator[ReplayedStep], report_progress: Callable[[ReplayedStep], None]) -> ServiceReplay:
        for step in steps:
            report_progress(step)
            if step.restarted or step.unknown:
                self._close(step.state.tick if step.restarted else None)
            if step.unknown:
                state = step.state
                self._span = UnknownStateSpan(step.unknown, state.epoch, state.tick, state.robot_time)
                self._result.spans.append(self._span)
            if step.recorded is None:
                self._result.lost += 1
            else:
                self._compare_step(step)
        self._close()
        return self._result

    def _compare_step(self, step: ReplayedStep) -> None:
        found = [(topic, self._differences(topic, one, other)) for topic, one, other in self._pairs(step)]
        if self._span is None:
            self._count(step.state, found)
        elif any(not item.exact_only for _, items in found for item in items):
            self._span.steps += len(self._agreeing) + 1
            self._agreeing.clear()
        else:
            self._agreeing.append((step.state, found))

    def _close(self, again_from: int | None = None) -> None:
        """Ends the span; the steps after its last difference count if there are enough of them."""
        if self._span is None:
            return
        self._span.again_from = again_from
        if len(self._agreeing) >= _AGREEING_OUTPUTS:
            self._span.agrees_from = self._agreeing[0][0].tick
            for state, found in self._agreeing:
                self._count(state, found)
        else:
            self._span.steps += len(self._agreeing)
        self._span = None
        self._agreeing.clear()

    def _count(self, state: StateMessage, compared_step: _StepDifferences) -> None:
        if not self._window[0] <= state.robot_time <= self._window[1]:
            return
        found = self._result
        for topic, items in compared_step:
            found.compared[topic.name] = found.compared.get(topic.name, 0) + 1
            found.identical[topic.name] = found.identical.get(topic.name, 0) + (not items)
            found.differing += [item for item in items if not item.exact_only]
            found.rounded += sum(item.exact_only for item in items)

    def _differences(self, topic: Topic, recorded: Message, replayed: Message | None) -> list[Difference]:
        if replayed is None:
            stamp = (recorded.epoch, recorded.tick, recorded.robot_time)
            return [Difference(*stamp, topic.name, "message", "sent", "none", exact_only=False)]
        recorded_fields = self._tape.fields[topic.message] - (_STATISTICS if self._result.spans else frozenset())
        return list(differences(topic.name, recorded, replayed, recorded_fields, self._tolerance))

    def _pairs(self, step: ReplayedStep) -> Iterator[tuple[Topic, Message, Message | None]]:
        """Yields topic, recorded and replayed message of a step; an action is paired with its verdict."""
        recorded = step.recorded
        topic = _TOPICS[self._result.service]
        assert recorded is not None
        yield topic, recorded, step.outputs.get(topic)
        if isinstance(recorded, VerdictMessage):
            action = self._action(recorded)
            if action is not None:
                yield ACTION, action, step.outputs.get(ACTION)

    def _action(self, verdict: VerdictMessage) -> ActionMessage | None:
        """The recorded action of a verdict; if two processes answered the tick, that of the same process."""
        known = self._tape.actions.get((verdict.epoch, verdict.tick), [])
        return next((action for action in known if action.values == verdict.action), known[0] if known else None)
