"""Histories of one robot: findings of the diagnosis, health of its services, residuals.

Findings are drawn as error and band, stage, model in force, and log lines where these change. Health is what services
report, and their silence. A residual is a measured minus the predicted state.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from safedpa.bus import FindingMessage, HealthMessage, ModelMessage, StateMessage, VerdictMessage
from safedpa.systems import System
from safedpa_services.dashboard.palette import (
    GREEN,
    GREY,
    HEALTH_COLOURS,
    ORANGE,
    PURPLE,
    SKY,
    VERMILION,
    YELLOW,
    series_colour,
)
from safedpa_services.dashboard.shapes import Curves, Note, States, StateSet, TimelineEntry, gap_if_huge

STAGE_COLOURS: Final = {
    "learning": GREY,
    "watching": GREEN,
    "raised": VERMILION,
    "searching": ORANGE,
    "candidates": YELLOW,
    "nothing": PURPLE,
}
_ERROR: Final = Curves((), ("error over 1 s", "end of its band"), (SKY, ORANGE), (2.5, 1.5))
_LARGEST = 1e6
_MOST_MODELS = 16
"""Number of colours of the model lane; further models share the last one."""
_LONGEST = 400
"""Characters of a log line."""


class FindingHistory:
    """Turns one robot's findings and model changes into entries."""

    def __init__(self) -> None:
        self._stage = ""
        self._number = 0
        self._models: list[str] = []
        self._model = ""
        self._lane = ""

    def lanes(self) -> list[TimelineEntry]:
        """Returns the current state of the lanes of diagnosis and model."""
        lanes = (("diagnosis", self._stage), ("model", self._lane))
        return [TimelineEntry(("verdict", name), States(state)) for name, state in lanes if state]

    @staticmethod
    def start() -> list[TimelineEntry]:
        """Returns the static entries with names and colours."""
        models = {f"model {number + 1}": (SKY if number % 2 == 0 else YELLOW) for number in range(_MOST_MODELS)}
        return [
            TimelineEntry(("diagnosis", "error"), _ERROR, static=True),
            TimelineEntry(("verdict", "diagnosis"), StateSet(STAGE_COLOURS), static=True),
            TimelineEntry(("verdict", "model"), StateSet(models), static=True),
        ]

    def add(self, message: FindingMessage | ModelMessage) -> list[TimelineEntry]:
        """Returns error and band, and a lane change and a log line if the stage or the model changes."""
        return self._finding(message) if isinstance(message, FindingMessage) else self._change(message)

    def _finding(self, message: FindingMessage) -> list[TimelineEntry]:
        # 0: not measured yet
        measured = tuple(value if value > 0.0 else math.nan for value in (message.error, message.band))
        values = tuple(gap_if_huge(value, _LARGEST) for value in measured)
        entries = [TimelineEntry(("diagnosis", "error"), Curves(values))]
        entries += self._in_force(message.model)
        if (message.stage, message.number) == (self._stage, self._number):
            return entries
        self._stage, self._number = message.stage, message.number
        colour = STAGE_COLOURS.get(message.stage, GREY)
        where = f" ({message.where})" if message.where else ""
        level = "WARN" if message.stage in ("raised", "candidates", "nothing") else "INFO"
        note = Note(f"diagnosis: {message.sentence}{where}"[:_LONGEST], colour, level)
        return [*entries, TimelineEntry(("verdict", "diagnosis"), States(message.stage)), TimelineEntry(("log",), note)]

    def _change(self, message: ModelMessage) -> list[TimelineEntry]:
        steps = {"offer": "is offered", "take": f"is used from tick {message.from_tick} on", "drop": "is dropped"}
        step = steps.get(message.step, message.step)
        who = f", by {message.who}" if message.who else ""
        text = f"model {message.fingerprint or message.replaces} {step}: {message.why}{who}"
        return [TimelineEntry(("log",), Note(text[:_LONGEST], PURPLE, "WARN" if message.step == "drop" else "INFO"))]

    def _in_force(self, fingerprint: str) -> list[TimelineEntry]:
        if fingerprint == self._model:
            return []
        self._model = fingerprint
        if fingerprint not in self._models and len(self._models) < _MOST_MODELS:
            self._models.append(fingerprint)
        number = self._models.index(fingerprint) + 1 if fingerprint in self._models else _MOST_MODELS
        self._lane = f"model {number}"
        return [TimelineEntry(("verdict", "model"), States(self._lane))]


SILENT_SECONDS = 1.0
"""A service is silent after four missing heartbeats."""

_MOST_SERVICES = 16


@dataclass
class _Service:
    heard: float
    shown: str
    own: bool
    """Whether it sent a heartbeat about this robot, not only about the fleet."""


class HealthHistory:
    """Turns heartbeats into changes of state and step times; ``now`` [s] is the dashboard's monotonic clock."""

    def __init__(self) -> None:
        self._services: dict[str, _Service] = {}

    def add(self, message: HealthMessage, now: float, *, own: bool = True) -> list[TimelineEntry]:
        """Returns the entries of a heartbeat.

        :param own: False for a heartbeat about the whole fleet, which is ignored once the service reports this robot
        """
        name = message.service or "unnamed"
        entries: list[TimelineEntry] = []
        if name not in self._services:
            if len(self._services) >= _MOST_SERVICES:
                return []
            entries = _styles(name, len(self._services))
            self._services[name] = _Service(now, "", own)
        service = self._services[name]
        if service.own and not own:
            return []
        service.heard, service.own = now, own
        if 0.0 <= message.step_microseconds < 1e9:
            entries.append(TimelineEntry(("steps", name), Curves((1e-3 * message.step_microseconds,))))
        return [*entries, *_change(name, service, message.state)]

    @property
    def states(self) -> dict[str, str]:
        """The shown state of each service."""
        return {name: service.shown for name, service in self._services.items()}

    def lanes(self) -> list[TimelineEntry]:
        """Returns the current state of each service's lane."""
        return [TimelineEntry(("services", name), States(state)) for name, state in self.states.items() if state]

    def silences(self, now: float) -> list[TimelineEntry]:
        """Returns the entries of services that fell silent since the last call."""
        late = [item for item in self._services.items() if now - item[1].heard > SILENT_SECONDS]
        return [entry for name, service in late for entry in _change(name, service, "silent")]


def _change(name: str, service: _Service, state: str) -> list[TimelineEntry]:
    if state == service.shown:
        return []
    service.shown = state
    return [TimelineEntry(("services", name), States(state))]


def _styles(name: str, index: int) -> list[TimelineEntry]:
    curve = Curves((), (name,), (series_colour(index),), (1.5,))
    return [
        TimelineEntry(("services", name), StateSet(HEALTH_COLOURS), static=True),
        TimelineEntry(("steps", name), curve, static=True),
    ]


_CACHED_TICKS = 8


class ResidualHistory:
    """Residuals r[k+1] = x[k+1] - predicted[k][0] of one robot and one epoch, with angle differences in (-pi, pi].

    A pair counts once, and only if the filter's action was in force over the period, because the prediction is for that
    action. Entries older than a few ticks are dropped.
    """

    def __init__(self, system: System) -> None:
        self._system = system
        self._predicted: dict[int, tuple[float, ...]] = {}
        self._measured: dict[int, tuple[float, ...]] = {}

    def add_state(self, state: StateMessage) -> tuple[float, ...] | None:
        """Returns the residual (states,) of this tick if its prediction has arrived."""
        if state.applied_by != "filter" or len(state.values) != len(self._system.state):
            return None
        return self._match(state.tick, self._measured, state.values)

    def add_verdict(self, verdict: VerdictMessage) -> tuple[int, tuple[float, ...]] | None:
        """Returns (tick, residual) of the next tick if its measurement has arrived already."""
        if not verdict.predicted or len(verdict.predicted[0]) != len(self._system.state):
            return None
        residual = self._match(verdict.tick + 1, self._predicted, verdict.predicted[0])
        return None if residual is None else (verdict.tick + 1, residual)

    def _match(
        self, tick: int, own: dict[int, tuple[float, ...]], values: tuple[float, ...]
    ) -> tuple[float, ...] | None:
        own[tick] = values
        measured, predicted = self._measured.get(tick), self._predicted.get(tick)
        for ticks in (self._measured, self._predicted):
            for old in [known for known in ticks if known <= tick - _CACHED_TICKS]:
                del ticks[old]
        if measured is None or predicted is None:
            return None
        del self._measured[tick], self._predicted[tick]
        return self._difference(measured, predicted)

    def _difference(self, measured: Sequence[float], predicted: Sequence[float]) -> tuple[float, ...]:
        with np.errstate(all="ignore"):  # the difference of huge numbers may overflow; the curve then has a gap
            change = self._system.difference(np.array(measured), np.array(predicted))
        return tuple(float(value) for value in change)
