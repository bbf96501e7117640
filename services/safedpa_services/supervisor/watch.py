"""What the supervisor hears on the bus: health of the services, verdicts, states; counted once per tick.

And what a finished loop amounts to, as one JSON document.
"""

from __future__ import annotations

import json
import time
from collections import Counter
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
from safedpa.errors import SafedpaError
from safedpa.safety.deadlock.detector import Stand, record_deadlock
from safedpa_services.supervisor.child import Child

__all__ = ["RunMonitor", "summary_of"]

_WHO = "'safedpa up', which is about to end"
_ORDER_SECONDS = 2.0
"""A busy machine is late with the answer; where there is no filter, that is known at once."""
_IS_STATIONARY = 0.02
"""m/s; slower than that a car stands."""


@dataclass
class RunMonitor:
    """Collects until asked; ``listen`` must be called often."""

    bus: Bus
    robot: str = "r1"
    """Name of the robot that is started here."""
    health: dict[str, tuple[HealthMessage, float]] = field(default_factory=dict)
    """By service: the newest heartbeat and when it came (monotonic, s)."""
    verdicts: Counter[str] = field(default_factory=Counter)
    verdict: VerdictMessage | None = None
    state: StateMessage | None = None
    finding: FindingMessage | None = None
    standstills: list[Stand] = field(default_factory=list)
    """Every stand of more than 5 s while something was requested."""

    def __post_init__(self) -> None:
        self._inbox = self.bus.inbox((HEALTH, VERDICT, STATE, FINDING))
        self._last: tuple[int, int] = (0, -1)

    def listen(self, wait: float) -> None:
        """Takes in what arrived, after ``wait`` [s]."""
        time.sleep(wait)  # not woken by every message: the loop has the processor first
        for item in self._inbox.take(0.0):
            if isinstance(item, ReceivedMessage):
                self._take(item)

    def stop_robot(self) -> bool:
        """Orders the filter to stop the robot; whether it took the order."""
        if self.state is None:
            return False
        try:
            answer = self.bus.request(self.robot, Request(do="stop", who=_WHO), _ORDER_SECONDS, ORDER)
        except SafedpaError:  # no answer, or one that is none: the robot brakes by itself
            return False
        return answer is not None and answer.ok

    def stationary_for(self) -> bool:
        """Whether the robot obeys the order: a car by standing; what has no stand obeys by hearing of it."""
        state, verdict = self.state, self.verdict
        if state is None or verdict is None or verdict.status != "stopped":
            return False
        return len(state.values) != 4 or bool(state.corridor) or abs(state.values[3]) <= _IS_STATIONARY

    def silent_for(self, service: str) -> float:
        """Seconds since the last heartbeat; infinite before the first."""
        return time.monotonic() - self.health[service][1] if service in self.health else float("inf")

    def has_hung(self, service: str, pid: int, seconds: float) -> bool:
        """Whether this process has told its health before, and has been silent for longer than that since."""
        reported = self.health.get(service)
        return reported is not None and reported[0].pid == pid and self.silent_for(service) > seconds

    def _take(self, item: ReceivedMessage) -> None:
        message = item.message
        if item.robot not in (self.robot, NO_ROBOT):
            return
        if isinstance(message, HealthMessage):
            self.health[message.service] = (message, item.at)
        elif isinstance(message, StateMessage):
            self.state = message
        elif isinstance(message, FindingMessage):
            self.finding = message
        elif isinstance(message, VerdictMessage) and (message.epoch, message.tick) != self._last:
            self._last = (message.epoch, message.tick)
            self.verdict = message
            self.verdicts[message.status] += 1
            record_deadlock(self.standstills, message)


_UNTOUCHED = ("passed", "disabled", "stopped")


def summary_of(
    robot_summary: Path,
    verdicts: Counter[str],
    children: list[Child],
    health: dict[str, HealthMessage],
    recording: Path,
    standstills: Sequence[Stand] = (),
    others: Mapping[str, Path] | None = None,
) -> dict[str, Any]:
    """The robot's own account, verdicts per status, stands, interventions, services with restarts, and the recording.

    ``others``: by name, where further robots left theirs; they stand under ``robots``.
    Raises SafedpaError when the robot left no account.
    """
    account = _account(robot_summary)
    recorder = health.get("recorder")
    failed = recorder.detail if recorder is not None and recorder.state == "failing" else None
    return {
        **account,
        "verdicts": dict(sorted(verdicts.items())),
        "standstills": list(standstills),
        "interventions": sum(count for status, count in verdicts.items() if status not in _UNTOUCHED),
        "services": [{"name": child.name, "pid": child.pid, "restarts": child.restarts} for child in children],
        "recording": str(recording),
        "recording_error": failed,
        **({"robots": {name: _account(path) for name, path in others.items()}} if others else {}),
    }


def _account(path: Path) -> dict[str, Any]:
    try:
        account: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise SafedpaError(f"the robot left no account of its run ({error}); see {path.parent}") from error
    return account
