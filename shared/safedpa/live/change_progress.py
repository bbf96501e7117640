"""The state of a model change in progress, and the monitor that finds services with another model.

``ChangeInProgress`` records which services have answered. ``ModelMismatchMonitor`` compares the models in heartbeats
with the agreed one.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal, final

from safedpa.bus import HealthMessage, ModelMessage, StateMessage, TakeoverMessage
from safedpa.live.versions import ModelVersion, OfferedEffect

__all__ = ["SERVICES", "ChangeInProgress", "ModelMismatchMonitor", "with_stamp"]

SERVICES = ("adaptation", "policy", "safety_filter")
"""The services that use the model and take part in a change."""


@dataclass
class ChangeInProgress:
    """A change from the request to the confirmation of the last service."""

    number: int
    why: str
    who: str
    replaces: str
    """Fingerprint of the model that was active when the change began."""
    versions: tuple[ModelVersion, ...]
    """The agreed versions if the change succeeds; the last one is then active."""
    version: ModelVersion | None
    """The last of them; None while its model is being created."""
    candidate: OfferedEffect = field(default_factory=lambda: OfferedEffect(""))
    """The accepted candidate."""
    repair: bool = False
    """Whether the change offers the active version again."""
    stage: Literal["preparing", "offer", "take"] = "preparing"
    steps: int = 0
    """Ticks since the stage began."""
    ready: set[str] = field(default_factory=set)
    taken: set[str] = field(default_factory=set)
    refused: str = ""
    """Why the change failed before the decision."""
    expected_effect: str = ""
    """Effect of the change that a service expects."""
    epoch: int = 0
    from_tick: int = 0

    @property
    def name(self) -> str:
        """Name of the change in sentences."""
        return f"change {self.number} ({self.why})"

    @property
    def consequence(self) -> str:
        """Expected effect as the end of a sentence; empty without one."""
        return f"; {self.expected_effect}" if self.expected_effect else ""

    @property
    def unconfirmed(self) -> str:
        """Names of the services that have not confirmed the new model."""
        return _names(set(SERVICES) - self.taken)

    @property
    def unready(self) -> str:
        """Names of the services that have not answered the offer."""
        return _names(set(SERVICES) - self.ready)

    def enter(self, stage: Literal["offer", "take"]) -> None:
        """Enters the next stage."""
        self.stage, self.steps, self.refused = stage, 0, ""

    def complete(self, made: OfferedEffect) -> None:
        """Sets the model to offer."""
        self.version = ModelVersion(
            made.fingerprint, made.document, made.margin, self.number, self.why, self.who, made.data
        )
        self.versions = (*self.versions, self.version)

    def hear(self, message: TakeoverMessage) -> None:
        """Handles a service's answer; ignores other changes and services that do not use the model."""
        if self.version is None or message.change != self.number or message.service not in SERVICES:
            return
        if message.fingerprint != self.version.fingerprint:
            self.refused = f"{message.service} answered for model {message.fingerprint}"
        elif message.state == "refused":
            self.refused = f"{message.service} refused it: {message.reason}"
        elif message.state in ("ready", "taken"):
            self.ready.add(message.service)
            self.expected_effect = message.expected_effect or self.expected_effect
            if message.state == "taken":
                self.taken.add(message.service)

    def message(self, step: Literal["offer", "take", "drop"], reason: str = "") -> ModelMessage:
        """Returns the message for a step, without a tick; ``reason`` is why the change is dropped."""
        version = self.version or ModelVersion("", "")
        offers, takes = step == "offer", step == "take"
        return ModelMessage(
            epoch=0,
            tick=0,
            robot_time=0.0,
            publish_time=0.0,
            step=step,
            change=self.number,
            fingerprint=version.fingerprint,
            replaces=self.replaces,
            document=version.document if offers else "",
            margin=version.margin if offers else "",
            from_tick=self.from_tick if takes else 0,
            who=self.who,
            why=f"{self.why}: {reason}" if reason else self.why,
            data=version.data,
        )


def with_stamp(message: ModelMessage, state: StateMessage, publish_time: float) -> ModelMessage:
    """Returns the message with epoch, tick and time of the newest state."""
    return replace(message, epoch=state.epoch, tick=state.tick, robot_time=state.robot_time, publish_time=publish_time)


def _names(services: set[str]) -> str:
    return ", ".join(sorted(services))


# Ticks after a change before a heartbeat with another model counts: it may have been sent before the change.
_SETTLE_TICKS = 10
# Ticks to wait after a failed repair; doubled each time, up to an hour at 20 Hz. A service that can never use the model
# must not cause a change every few seconds.
_FIRST_PAUSE = 200
_LONGEST_PAUSE = 72000


@final
class ModelMismatchMonitor:
    """Finds services with another model from their newest heartbeats, with an exponential back-off of repairs."""

    def __init__(self) -> None:
        self._health: dict[str, HealthMessage] = {}
        self._since: tuple[int, int] | None = None
        self._ticks = 0
        self._again_at, self._pause = 0, _FIRST_PAUSE

    def hear(self, message: HealthMessage) -> None:
        """Stores a heartbeat."""
        if message.service in SERVICES:
            self._health[message.service] = message

    def settle(self, state: StateMessage, *, again: bool) -> None:
        """Counts ticks; call once per tick, and with ``again`` at the tick from which another version is active."""
        if self._since is None or self._since[0] != state.epoch or again:
            self._since = (state.epoch, state.tick)
        self._ticks += not again

    def found(self, fingerprint: str) -> str:
        """Describes services that use another model than the active one; empty if there are none, or it is too
        early."""
        if self._since is None or self._ticks < self._again_at:
            return ""
        epoch, tick = self._since
        strays = {
            name: health.model
            for name, health in self._health.items()
            if health.epoch == epoch and health.tick >= tick + _SETTLE_TICKS and health.model not in ("", fingerprint)
        }
        # The next report needs new heartbeats, sent after the repair that follows this one.
        if strays:
            self._health = {}
        return ", ".join(f"{name} uses {model}" for name, model in sorted(strays.items()))

    def corrected(self) -> None:
        """Resets the back-off after a successful change."""
        self._pause = _FIRST_PAUSE

    def not_corrected(self) -> None:
        """Delays the next repair after a failed one."""
        self._again_at = self._ticks + self._pause
        self._pause = min(2 * self._pause, _LONGEST_PAUSE)
