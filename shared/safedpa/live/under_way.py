"""One change of a model while it is being made: who has answered what.

And services that use another model than the one agreed on, as their health tells.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal, final

from safedpa.bus import HealthMessage, ModelMessage, StateMessage, TakeoverMessage
from safedpa.live.versions import ModelVersion, OfferedEffect

__all__ = ["SERVICES", "ChangeInProgress", "ModelMismatchMonitor", "with_stamp"]

SERVICES = ("adaptation", "policy", "safety_filter")
"""Who uses the model, and has to take over a new one."""


@dataclass
class ChangeInProgress:
    """A change from the request to the last service's confirmation."""

    number: int
    why: str
    who: str
    replaces: str
    """Fingerprint of the model in force when it began."""
    versions: tuple[ModelVersion, ...]
    """Agreed on if it succeeds, the last of them in force."""
    version: ModelVersion | None
    """The last of them; None while its document is being made."""
    candidate: OfferedEffect = field(default_factory=lambda: OfferedEffect(""))
    """What was accepted."""
    repair: bool = False
    """Whether it offers the version in force again."""
    stage: Literal["preparing", "offer", "take"] = "preparing"
    steps: int = 0
    """Ticks since the stage began."""
    ready: set[str] = field(default_factory=set)
    taken: set[str] = field(default_factory=set)
    refused: str = ""
    """Why it cannot be, before it was decided."""
    expected_effect: str = ""
    """What a service says that the change will do."""
    epoch: int = 0
    from_tick: int = 0

    @property
    def name(self) -> str:
        """For sentences."""
        return f"change {self.number} ({self.why})"

    @property
    def consequence(self) -> str:
        """What it does, as the end of a sentence; empty where nothing was told."""
        return f"; {self.expected_effect}" if self.expected_effect else ""

    @property
    def unconfirmed(self) -> str:
        """Names of the services that have not said to use the new model."""
        return _names(set(SERVICES) - self.taken)

    @property
    def unready(self) -> str:
        """Names of the services that have not answered the offer."""
        return _names(set(SERVICES) - self.ready)

    def enter(self, stage: Literal["offer", "take"]) -> None:
        """Goes on to the next stage."""
        self.stage, self.steps, self.refused = stage, 0, ""

    def complete(self, made: OfferedEffect) -> None:
        """The document is there."""
        self.version = ModelVersion(
            made.fingerprint, made.document, made.margin, self.number, self.why, self.who, made.data
        )
        self.versions = (*self.versions, self.version)

    def hear(self, message: TakeoverMessage) -> None:
        """Takes a service's answer; what is about another change, or from no one who uses the model, is nothing."""
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
        """What the services are told; unstamped. ``reason``: why it is dropped."""
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
    """The message with the stamp of the newest state."""
    return replace(message, epoch=state.epoch, tick=state.tick, robot_time=state.robot_time, publish_time=publish_time)


def _names(services: set[str]) -> str:
    return ", ".join(sorted(services))


_SETTLE_TICKS = 10
"""After the tick of a change, before a service that says to use another model is believed."""
_FIRST_PAUSE = 200
"""Ticks after a repair that came to nothing; doubled each time."""
_LONGEST_PAUSE = 72000
"""Ticks: an hour at 20 Hz."""


@final
class ModelMismatchMonitor:
    """Keeps the newest health of every service, and how long to wait after a repair that failed."""

    def __init__(self) -> None:
        self._health: dict[str, HealthMessage] = {}
        self._since: tuple[int, int] | None = None
        self._ticks = 0
        self._again_at, self._pause = 0, _FIRST_PAUSE

    def hear(self, message: HealthMessage) -> None:
        """Takes what a service says of itself."""
        if message.service in SERVICES:
            self._health[message.service] = message

    def settle(self, state: StateMessage, *, again: bool) -> None:
        """Once per tick; ``again`` from the tick on at which another version is in force."""
        if self._since is None or self._since[0] != state.epoch or again:
            self._since = (state.epoch, state.tick)
        self._ticks += not again

    def found(self, fingerprint: str) -> str:
        """Who uses another model than the one in force, in words; empty: no one, or it is too early to say."""
        if self._since is None or self._ticks < self._again_at:
            return ""
        epoch, tick = self._since
        strays = {
            name: health.model
            for name, health in self._health.items()
            if health.epoch == epoch and health.tick >= tick + _SETTLE_TICKS and health.model not in ("", fingerprint)
        }
        if strays:
            self._health = {}
        return ", ".join(f"{name} uses {model}" for name, model in sorted(strays.items()))

    def corrected(self) -> None:
        """A change was taken by everyone."""
        self._pause = _FIRST_PAUSE

    def not_corrected(self) -> None:
        """A repair came to nothing: the next one waits."""
        self._again_at = self._ticks + self._pause
        self._pause = min(2 * self._pause, _LONGEST_PAUSE)
