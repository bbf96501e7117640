"""What is known of each source of scans: when it measured last, and what is wrong with it."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import TYPE_CHECKING, final

from safedpa.bus.messages.messages import ScanMessage, StateMessage
from safedpa.perception.settings import PerceptionSettings

if TYPE_CHECKING:
    from safedpa.perception.scan import ScanRays

__all__ = ["Sources"]

_FROZEN = 3
"""Scans that are the same to the last digit: no sensor with noise does that."""
_CONTRADICTS = 0.6
"""Share of a scan's cells that may move. Six people in a room of 7 x 6 m make 0.15 of them, the same room seen
the wrong way round 0.9, from a mount that is knocked by 60 degrees 0.9."""
_CONTRADICTIONS = 3
_SEES = 0.25
"""Share of the rays that must measure something."""


@dataclass
class _Source:
    time: float | None = None
    """s; when it measured what was looked at last."""
    heard: float | None = None
    """s; when it measured what was heard last."""
    number: int = -1
    ranges: tuple[float, ...] = ()
    same: int = 0
    contradictions: int = 0
    believed: float = 1.0
    early: float = 0.0
    """s by which the last scan was from the future; 0: it was not."""


@final
class Sources:
    """Of one robot, by the names that its states give."""

    def __init__(self, settings: PerceptionSettings) -> None:
        self._settings = settings
        self._known: dict[str, _Source] = {}
        self._off: frozenset[str] = frozenset()

    def expect(self, state: StateMessage, off: frozenset[str] = frozenset()) -> None:
        """The sources that there are now, and which of them are not listened to."""
        self._known = {name: self._known.get(name) or _Source() for name in state.sources}
        self._off = off

    def believes(self, scan: ScanMessage, state: StateMessage) -> bool:
        """Whether a scan is of a source of this robot, newer than the last one, and not the same again."""
        source = self._known.get(scan.source)
        if (
            source is None
            or scan.source in self._off
            or scan.epoch != state.epoch
            or (source.heard is not None and scan.robot_time <= source.heard)
        ):
            return False
        source.same = source.same + 1 if scan.ranges == source.ranges else 0
        source.heard, source.number, source.ranges, source.early = scan.robot_time, scan.number, scan.ranges, 0.0
        return source.same < _FROZEN

    def early(self, scan: ScanMessage, ahead: float) -> None:
        """A scan that was not taken up, since it says to be measured ``ahead`` [s] of the state after it."""
        if scan.source in self._known:
            self._known[scan.source].early = ahead

    def looked(self, scan: ScanMessage, sweep: ScanRays, contradicted: float) -> None:
        """What a scan that was taken up looked like."""
        source = self._known[scan.source]
        source.time = scan.robot_time
        source.believed = sweep.believed
        again = contradicted > _CONTRADICTS
        source.contradictions = (
            min(source.contradictions + 1, 2 * _CONTRADICTIONS) if again else max(source.contradictions - 1, 0)
        )

    def ages(self, now: float) -> tuple[float, ...]:
        """s since each source measured what was looked at last; -1 where nothing was.

        What is told rests on none that is off: in its place stands the oldest of the others.
        """
        reported = {name: -1.0 if one.time is None else now - one.time for name, one in self._known.items()}
        others = [age for name, age in reported.items() if name not in self._off]
        oldest = -1.0 if not others or min(others) == -1.0 else max(others)
        return tuple(oldest if name in self._off else age for name, age in reported.items())

    def problems(self, now: float) -> tuple[str, ...]:
        """A sentence for each thing that is wrong."""
        if self._known and self._off.issuperset(self._known):
            return (f"no source is listened to: {', '.join(self._known)} switched off",)
        used = ((name, one) for name, one in self._known.items() if name not in self._off)
        return tuple(filter(None, (self._ahead(name, one, now) or self._wrong(name, one, now) for name, one in used)))

    def _ahead(self, name: str, source: _Source, now: float) -> str:
        if source.early and (source.time is None or now - source.time > self._settings.time_out_of(name)):
            return f"the source {name} tells scans from {source.early:.2f} s ahead of the robot's clock"
        return ""

    def _wrong(self, name: str, source: _Source, now: float) -> str:
        time_out = self._settings.time_out_of(name)
        if source.time is None and source.same < _FROZEN:
            return f"nothing was {'heard of' if source.heard is None else 'looked at of'} the source {name}"
        if source.believed < _SEES:
            return f"the source {name} measures {100.0 * source.believed:.0f} % of its rays, wanted {100 * _SEES:.0f} %"
        if source.same >= _FROZEN and source.heard is not None and now - source.heard <= time_out:
            return f"the source {name} has told the same for {source.same + 1} scans: it is frozen"
        age = inf if source.time is None else now - source.time
        if age > time_out:
            return f"the source {name} was silent for {age:.2f} s, its time-out is {time_out:g} s"
        if source.contradictions >= _CONTRADICTIONS:
            return (
                f"the source {name} contradicts what it saw before: is its mount, its direction or the robot's own way "
                "wrong?"
            )
        return ""
