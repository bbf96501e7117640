"""Health of each sensor: the age of its last scan, and its problems."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import TYPE_CHECKING, final

from safedpa.bus.messages.messages import ScanMessage, StateMessage
from safedpa.perception.settings import PerceptionSettings

if TYPE_CHECKING:
    from safedpa.perception.scan import ScanRays

__all__ = ["Sources"]

_FROZEN_SCANS = 3
"""Consecutive identical scans after which a sensor counts as frozen; a sensor with noise never repeats one."""
_CONTRADICTED_SHARE = 0.6
"""Share of moving cells above which a scan contradicts the map. Six people in a room of 7 x 6 m give 0.15; a mirrored
scan, or a mount turned by 60 degrees, gives 0.9."""
_MAX_CONTRADICTIONS = 3
_MIN_MEASURED_SHARE = 0.25
"""Smallest share of rays with a valid measurement."""


@dataclass
class _Source:
    time: float | None = None
    """Time of the last processed scan, s."""
    heard: float | None = None
    """Time of the last received scan, s."""
    number: int = -1
    ranges: tuple[float, ...] = ()
    same: int = 0
    contradictions: int = 0
    measured_share: float = 1.0
    early: float = 0.0
    """s by which the last scan was ahead of the robot's clock; 0 if it was not."""


@final
class Sources:
    """Health of all sources of one robot, by the names in its states."""

    def __init__(self, settings: PerceptionSettings) -> None:
        self._settings = settings
        self._known: dict[str, _Source] = {}
        self._off: frozenset[str] = frozenset()

    def expect(self, state: StateMessage, off: frozenset[str] = frozenset()) -> None:
        """Sets the sources of the present state, and which of them are switched off."""
        self._known = {name: self._known.get(name) or _Source() for name in state.sources}
        self._off = off

    def accepts(self, scan: ScanMessage, state: StateMessage) -> bool:
        """Whether a scan is from an active source of this robot, newer than the last one, and not frozen."""
        source = self._known.get(scan.source)
        if (
            source is None
            or scan.source in self._off
            or scan.epoch != state.epoch
            or (source.heard is not None and scan.robot_time <= source.heard)
        ):
            return False
        again = scan.ranges == source.ranges and not self._settings.repeats(scan.source)
        source.same = source.same + 1 if again else 0
        source.heard, source.number, source.ranges, source.early = scan.robot_time, scan.number, scan.ranges, 0.0
        return source.same < _FROZEN_SCANS

    def note_early(self, scan: ScanMessage, ahead: float) -> None:
        """Notes a scan that was refused because its time is ``ahead`` [s] of the next state."""
        if scan.source in self._known:
            self._known[scan.source].early = ahead

    def processed(self, scan: ScanMessage, sweep: ScanRays, contradicted: float) -> None:
        """Notes the quality of a processed scan."""
        source = self._known[scan.source]
        source.time = scan.robot_time
        source.measured_share = sweep.measured_share
        again = contradicted > _CONTRADICTED_SHARE
        source.contradictions = (
            min(source.contradictions + 1, 2 * _MAX_CONTRADICTIONS) if again else max(source.contradictions - 1, 0)
        )

    def ages(self, now: float) -> tuple[float, ...]:
        """Age of the last processed scan of each source, s; -1 if there is none.

        A source that is switched off has the age of the oldest other one, because it does not contribute.
        """
        ages = {name: -1.0 if one.time is None else now - one.time for name, one in self._known.items()}
        others = [age for name, age in ages.items() if name not in self._off]
        oldest = -1.0 if not others or min(others) == -1.0 else max(others)
        return tuple(oldest if name in self._off else age for name, age in ages.items())

    def problems(self, now: float) -> tuple[str, ...]:
        """A sentence for each problem."""
        if self._known and self._off.issuperset(self._known):
            return (f"all sources are switched off: {', '.join(self._known)}",)
        used = ((name, one) for name, one in self._known.items() if name not in self._off)
        return tuple(filter(None, (self._ahead(name, one, now) or self._wrong(name, one, now) for name, one in used)))

    def _ahead(self, name: str, source: _Source, now: float) -> str:
        if source.early and (source.time is None or now - source.time > self._settings.time_out_of(name)):
            return f"the source {name} sends scans {source.early:.2f} s ahead of the robot's clock"
        return ""

    def _wrong(self, name: str, source: _Source, now: float) -> str:
        time_out = self._settings.time_out_of(name)
        if source.time is None and source.same < _FROZEN_SCANS:
            return f"no scan was {'received' if source.heard is None else 'used'} from the source {name}"
        if source.measured_share < _MIN_MEASURED_SHARE:
            wanted = 100 * _MIN_MEASURED_SHARE
            return (
                f"the source {name} measures {100.0 * source.measured_share:.0f} % of its rays, wanted {wanted:.0f} %"
            )
        if source.same >= _FROZEN_SCANS and source.heard is not None and now - source.heard <= time_out:
            return f"the source {name} sent {source.same + 1} identical scans: it is frozen"
        age = inf if source.time is None else now - source.time
        if age > time_out:
            return f"the source {name} was silent for {age:.2f} s, its time-out is {time_out:g} s"
        if source.contradictions >= _MAX_CONTRADICTIONS:
            return f"the source {name} contradicts its earlier scans: check its mount, its direction and the odometry"
        return ""
