"""Events of a service: robots that come and go, rejected messages, and changes of its outputs.

Only changes are logged, not ticks: a filter that is in fallback for a minute logs one line at the start and one at the
end.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from safedpa.bus.logging import log_event
from safedpa.bus.messages.messages import FindingMessage, Message, ModelMessage, TakeoverMessage, VerdictMessage
from safedpa.bus.service.node import Outputs

_STEPS = {"offer": "model.offered", "take": "model.decided", "drop": "model.dropped"}
_ANSWERS = {"ready": "model.ready", "taken": "model.taken", "refused": "model.refused"}
_STATUS_KINDS = {"stopped": "filter.stopped", "disabled": "filter.disabled"}
_WARNINGS = ("model.dropped", "model.refused", "filter.fallback_entered", "filter.disabled", "filter.stopped")


# Checked by exact type before anything else: most outputs, such as actions, are never logged.
_LOGGED = frozenset((VerdictMessage, ModelMessage, TakeoverMessage, FindingMessage))


class ServiceLog:
    """Events of the service ``service``, written by ``log``, which has the signature of ``log_event``."""

    def __init__(self, service: str, log: Callable[..., None] = log_event) -> None:
        self._service, self._log = service, log
        self._statuses: dict[str, tuple[str, int]] = {}
        """Status of each robot, and the tick at which it began."""
        self._stages: dict[str, str] = {}

    @classmethod
    def silent(cls) -> ServiceLog:
        """Returns a log that writes nothing, for experiments in one process."""
        return cls("", lambda *_arguments, **_more: None)

    def met(self, robot: str, tick: int, *, again: bool) -> None:
        """Logs the first state of a robot, or with ``again`` the first one of a new epoch."""
        kind = "robot.restarted" if again else "robot.met"
        sentence = f"'{robot}' was restarted" if again else f"received the first state of '{robot}'"
        self._event(kind, sentence, robot, tick)
        self._drop(robot)

    def forgot(self, robot: str) -> None:
        """Logs that a robot left."""
        self._event("robot.forgotten", f"'{robot}' was silent for long and is forgotten", robot)
        self._drop(robot)

    def refused(self, reason: str, robot: str = "", tick: int = -1, *, second: bool = False) -> None:
        """Logs a rejected message; ``second`` if it came from a second robot under a name in use."""
        kind = "robot.second_refused" if second else "message.refused"
        self._event(kind, reason, robot, tick, level="warning")

    def failed(self, reason: str, error: Exception, robot: str = "", tick: int = -1) -> None:
        """Logs an unexpected exception about one robot, with its location in the code."""
        # The innermost frame is where the exception was raised; a whole traceback does not fit on one line.
        trace = error.__traceback__
        while trace is not None and trace.tb_next is not None:
            trace = trace.tb_next
        where = "" if trace is None else f"{trace.tb_frame.f_code.co_filename}:{trace.tb_lineno}"
        self._event("robot.step_failed", reason, robot, tick, level="error", where=where)

    def notice(self, robot: str, outputs: Outputs) -> None:
        """Logs published messages about a robot that differ from the previous ones."""
        for message in outputs.values():
            if type(message) in _LOGGED:
                self._message(robot, message)

    def _message(self, robot: str, message: Message) -> None:
        if isinstance(message, VerdictMessage):
            self._verdict(robot, message)
        elif isinstance(message, ModelMessage):
            about: dict[str, Any] = {"model": message.fingerprint, "change": message.change, "who": message.who}
            self._event(_STEPS[message.step], message.why or message.step, robot, message.tick, **about)
        elif isinstance(message, TakeoverMessage):
            sentence = message.reason or f"model {message.fingerprint} is {message.state}"
            self._event(_ANSWERS[message.state], sentence, robot, message.tick, change=message.change)
        elif isinstance(message, FindingMessage) and self._stages.get(robot, "learning") != message.stage:
            self._stages[robot] = message.stage
            level = "warning" if message.stage == "raised" else "info"
            self._event("finding.changed", message.sentence, robot, message.tick, level=level, stage=message.stage)

    def _verdict(self, robot: str, message: VerdictMessage) -> None:
        (before, since), name = self._statuses.get(robot, ("", 0)), message.status
        if before == name:
            return
        self._statuses[robot] = name, message.tick
        if name == "fallback":
            self._event("filter.fallback_entered", message.sentence, robot, message.tick)
        elif name in _STATUS_KINDS:
            self._event(_STATUS_KINDS[name], message.sentence, robot, message.tick)
        if before == "fallback":
            lasted = message.tick - since
            self._event("filter.fallback_left", f"decides again after {lasted} ticks", robot, message.tick)
        elif before == "stopped":
            self._event("filter.released", "may drive again", robot, message.tick)

    def _drop(self, robot: str) -> None:
        self._statuses.pop(robot, None)
        self._stages.pop(robot, None)

    def _event(self, kind: str, sentence: str, robot: str, tick: int = -1, *, level: str = "", **more: Any) -> None:
        chosen = level or ("warning" if kind in _WARNINGS else "info")
        self._log(kind, sentence, level=chosen, robot=robot, tick=tick, service=self._service, **more)
