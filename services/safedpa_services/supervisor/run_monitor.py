"""Follows one robot's run on the bus: health of the services, states, verdicts and findings; and the run's summary."""

from __future__ import annotations

import json
import time
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from safedpa.bus import (
    FINDING,
    HEALTH,
    NO_ROBOT,
    STATE,
    VERDICT,
    Bus,
    FindingMessage,
    HealthMessage,
    ReceivedMessage,
    Request,
    StateMessage,
    VerdictMessage,
)
from safedpa.bus.messages.requests import ORDER
from safedpa.bus.monitor import MeasurementTimes
from safedpa.errors import SafedpaError
from safedpa.safety.deadlock.detector import Stand, record_deadlock
from safedpa_services.supervisor.child import Child

_WHO = "'safedpa up', which is about to end"
_ORDER_SECONDS = 2.0
"""Timeout of a stop order. A busy machine answers late; without a filter the request fails at once."""
_STATIONARY_SPEED = 0.02
"""m/s; a slower car counts as stationary."""
_MOST_NOTICES = 100


@dataclass
class RunMonitor:
    """Collects the messages of one robot's run; call ``listen`` often."""

    bus: Bus
    robot: str = "r1"
    """Name of the robot on the bus."""
    health: dict[str, tuple[HealthMessage, float]] = field(default_factory=dict)
    """By service: the newest heartbeat and its time of arrival (monotonic clock) [s]."""
    verdicts: Counter[str] = field(default_factory=Counter)
    verdict: VerdictMessage | None = None
    state: StateMessage | None = None
    finding: FindingMessage | None = None
    standstills: list[Stand] = field(default_factory=list)
    """Times for which the robot was stationary for more than 5 s although the policy requested motion."""
    state_at: float | None = None
    """Time [s, monotonic clock] at which the newest state was measured; None before the first."""
    verdict_at: float | None = None
    """The same of the state that the newest verdict is about."""
    finding_at: float | None = None
    notices: deque[str] = field(default_factory=lambda: deque(maxlen=_MOST_NOTICES))
    """Sentences about the run for the user that were not shown yet; the reader removes them."""

    def __post_init__(self) -> None:
        self._times = MeasurementTimes()
        self._inbox = self.bus.inbox((HEALTH, VERDICT, STATE, FINDING))
        self._last: tuple[int, int] = (0, -1)

    def listen(self, wait: float) -> None:
        """Processes the messages that arrive within ``wait`` [s]."""
        time.sleep(wait)  # instead of waking up for every message, which would take CPU time from the control loop
        for item in self._inbox.take(0.0):
            if isinstance(item, ReceivedMessage):
                self._take(item)

    def stop_robot(self) -> bool:
        """Orders the filter to stop the robot; returns whether it accepted the order."""
        if self.state is None:
            return False
        try:
            answer = self.bus.request(self.robot, Request(do="stop", who=_WHO), _ORDER_SECONDS, ORDER)
        except SafedpaError:  # no valid answer: the robot brakes itself when it ends
            return False
        return answer is not None and answer.ok

    def has_obeyed_stop(self) -> bool:
        """Whether the robot obeys the stop order: the verdict is ``stopped``, and a car is stationary."""
        state, verdict = self.state, self.verdict
        if state is None or verdict is None or verdict.status != "stopped":
            return False
        return len(state.values) != 4 or bool(state.corridor) or abs(state.values[3]) <= _STATIONARY_SPEED

    def ages(self) -> tuple[float | None, float | None]:
        """Returns the ages [s] of the newest state and verdict, counted from the measurement; None: none arrived."""
        now = time.monotonic()
        of_state = None if self.state_at is None else max(0.0, now - self.state_at)
        return of_state, None if self.verdict_at is None else max(0.0, now - self.verdict_at)

    def silent_for(self, service: str) -> float:
        """Returns the time since the last heartbeat [s]; infinite before the first."""
        return time.monotonic() - self.health[service][1] if service in self.health else float("inf")

    def has_hung(self, service: str, pid: int, seconds: float) -> bool:
        """Whether the process ``pid`` has sent heartbeats, and then none for more than ``seconds``."""
        known = self.health.get(service)
        return known is not None and known[0].pid == pid and self.silent_for(service) > seconds

    def _take(self, item: ReceivedMessage) -> None:
        message = item.message
        if item.robot not in (self.robot, NO_ROBOT):
            return
        if isinstance(message, HealthMessage):
            self.health[message.service] = (message, item.at)
        elif isinstance(message, StateMessage):
            self.state, self.state_at = message, self._times.of(message, item.at)
        elif isinstance(message, FindingMessage):
            self.finding, self.finding_at = message, self._times.of(message, item.at)
        elif isinstance(message, VerdictMessage) and (message.epoch, message.tick) != self._last:
            self._last = (message.epoch, message.tick)
            self.verdict, self.verdict_at = message, self._times.of(message, item.at)
            self.verdicts[message.status] += 1
            record_deadlock(self.standstills, message)


_NO_INTERVENTION = ("passed", "disabled", "stopped")


def run_summary(
    robot_summary: Path,
    verdicts: Counter[str],
    children: list[Child],
    health: dict[str, HealthMessage],
    recording: Path,
    standstills: Sequence[Stand] = (),
    others: Mapping[str, Path] | None = None,
) -> dict[str, Any]:
    """Returns the summary of a run: the robot's own summary, verdicts, standstills, restarts and the recording.

    :param robot_summary: file with the robot's summary
    :param others: by name: the files of further robots, whose summaries go under ``robots``

    ``recording_error`` says why the recording is incomplete, None: it is complete. Raises SafedpaError if a robot's
    summary cannot be read.
    """
    return {
        **_robot_summary(robot_summary),
        "verdicts": dict(sorted(verdicts.items())),
        "standstills": list(standstills),
        "interventions": sum(count for status, count in verdicts.items() if status not in _NO_INTERVENTION),
        "services": [
            {"name": child.name, "pid": child.pid, "restarts": child.restarts, "cause": child.cause}
            for child in children
        ],
        "recording": str(recording),
        "recording_error": _recording_error(health.get("recorder"), children),
        **({"robots": {name: _robot_summary(path) for name, path in others.items()}} if others else {}),
    }


def _recording_error(last: HealthMessage | None, children: Sequence[Child]) -> str | None:
    if last is not None and last.state == "failing":
        return last.detail
    # The last heartbeat of a recorder that was killed says nothing about the end of its file.
    code = next((child.exit_code for child in children if child.name == "recorder"), None)
    if not code:
        return None
    return f"the recorder was killed by signal {-code}" if code < 0 else f"the recorder ended with exit code {code}"


def _robot_summary(path: Path) -> dict[str, Any]:
    try:
        summary: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise SafedpaError(f"the robot wrote no summary of its run ({error}); see the logs in {path.parent}") from error
    return summary
