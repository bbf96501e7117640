"""What a fault did, in numbers: from the robot's own trace, what was heard on the bus, and what was recorded."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

from safedpa.bus import STATE, VERDICT, VerdictMessage
from safedpa.records import read_messages
from safedpa_sim.robots.run_summary import TracedPeriod

Stamp = tuple[int, int]


@dataclass(frozen=True)
class Recorded:
    """(epoch, tick) of states and verdicts in the recordings of one robot."""

    states: frozenset[Stamp]
    verdicts: frozenset[Stamp]
    messages: int
    """Of every topic and robot."""

    def lost(self, states: Iterable[Stamp], verdicts: Iterable[Stamp]) -> tuple[int, int]:
        """How many of these states and verdicts are in no recording."""
        return len(set(states) - self.states), len(set(verdicts) - self.verdicts)


def read_recorded(files: Sequence[Path], robot: str) -> Recorded:
    """Reads every file up to where it is damaged."""
    found: dict[str, set[Stamp]] = {STATE.name: set(), VERDICT.name: set()}
    count = 0
    for file in files:
        for key, _, message in read_messages(file, []):
            count += 1
            _, _, name, topic, *_ = key.split("/")
            if name == robot and topic in found:
                found[topic].add((message.epoch, message.tick))
    return Recorded(frozenset(found[STATE.name]), frozenset(found[VERDICT.name]), count)


LARGEST_AGE_PERIODS = 2.0
"""Between a state and the moment in which its action begins to act."""
_TOLERANCE = 1e-12
_IN_A_ROW = 10
"""Periods driven, before the loop counts as driving again."""
_HICCUP_PERIODS = 2
"""Periods in a row that a busy machine may cost without this being an outage."""


@dataclass(frozen=True)
class Episode:
    """When a fault began, when it was corrected, when the loop was left to itself again; monotonic, s."""

    struck: float
    corrected: float
    ended: float


@dataclass(frozen=True)
class Evidence:
    """The robot's trace, what was heard of the filter, and the robot's period [s]."""

    periods: Sequence[TracedPeriod]
    verdicts: Mapping[Stamp, VerdictMessage]
    actions: Mapping[Stamp, set[tuple[float, ...]]]
    period: float

    def within(self, begin: float, end: float) -> list[TracedPeriod]:
        """Periods that began to be driven in [begin, end)."""
        return [lived for lived in self.periods if begin <= lived.applied_at < end]

    def is_fallback(self, lived: TracedPeriod) -> bool:
        """Whether the filter braked for want of an input; False where its verdict was not heard."""
        verdict = self.verdicts.get((lived.epoch, lived.tick))
        return verdict is not None and verdict.status == "fallback"

    def is_driven(self, lived: TracedPeriod) -> bool:
        """Whether the filter, with everything that it needs, chose what was done."""
        return lived.applied_by == "filter" and not self.is_fallback(lived)


def collisions_in(periods: Iterable[TracedPeriod]) -> int:
    """New contacts during these periods; a robot that restarts begins with none."""
    count, before = 0, dict[int, int]()
    for lived in periods:
        count += lived.collisions - before.get(lived.epoch, lived.collisions)
        before[lived.epoch] = lived.collisions
    return count


def stale_in(periods: Iterable[TracedPeriod], evidence: Evidence) -> list[str]:
    """Every action that was applied and must not have been, in words.

    Those that are of another state than that of their period, that began to act more than ``LARGEST_AGE_PERIODS`` after
    it, or that the filter never sent for it (where it was heard at all).
    """
    found = []
    for lived in periods:
        if lived.applied_by != "filter":
            continue
        if (lived.action_epoch, lived.action_tick) != (lived.epoch, lived.tick):
            found.append(f"tick {lived.tick}: action of tick {lived.action_tick}")
        elif lived.age > LARGEST_AGE_PERIODS * evidence.period:
            found.append(f"tick {lived.tick}: action began to act after {lived.age:.3f} s")
        elif not _was_sent(lived, evidence.actions.get((lived.epoch, lived.tick))):
            found.append(f"tick {lived.tick}: the filter never sent {lived.applied}")
    return found


def _was_sent(lived: TracedPeriod, sent: set[tuple[float, ...]] | None) -> bool:
    if not sent:
        return True  # the observer's own link was down
    return any(max(abs(a - b) for a, b in zip(lived.applied, one, strict=True)) <= _TOLERANCE for one in sent)


def recovery_of(evidence: Evidence, episode: Episode) -> float | None:
    """s from the recovery to the end of the last outage; 0 when it had never stopped or was over before.

    An outage is a stretch of more than ``_HICCUP_PERIODS`` periods that were not driven, or were not lived at all. None
    when the last one lasts until less than ten periods before the episode's end.
    """
    limit = (_HICCUP_PERIODS + 1) * evidence.period
    driven = [one.applied_at for one in evidence.within(episode.struck, episode.ended) if evidence.is_driven(one)]
    starts = [episode.struck, *driven]
    ends = [*driven, episode.ended]
    over = [end for start, end in zip(starts, ends, strict=True) if end - start > limit and end > episode.corrected]
    if not over:
        return 0.0
    if sum(at >= over[-1] for at in driven) < _IN_A_ROW:
        return None
    return over[-1] - episode.corrected


@dataclass(frozen=True)
class Outcome:
    """What one fault did, from its beginning to a second after the loop drove again."""

    name: str
    sentence: str
    held: bool
    """Whether every invariant held."""
    broken: tuple[str, ...]
    """Those that did not, in words."""
    speed: float
    """m/s when it struck."""
    collisions: int
    stale_actions: int
    """Applied, and older than allowed or of another state."""
    periods: int
    watchdog: int
    """Periods in which the robot braked by itself."""
    fallbacks: int
    """Periods in which the filter braked for want of an input."""
    recovery_seconds: float | None
    """From the recovery until the loop drove again; 0 when it had never stopped, None when it did not."""
    whole_seconds: float | None
    """From the recovery until every process had reported its health again; None when one did not."""
    states_not_recorded: int
    verdicts_not_recorded: int
    """Of those that were heard on the bus."""


@dataclass(frozen=True)
class Campaign:
    """What came of all faults."""

    outcomes: tuple[Outcome, ...]
    periods: int
    """Lived by all robots, between the faults as well."""
    collisions: int
    """In all of them."""
    stale_actions: int
    """In all of them."""
    acknowledged: int
    """Messages that the recorders said were on the disk."""
    recorded: int
    """Messages that can be read from the recordings; fewer than acknowledged would be a broken promise."""

    @property
    def held(self) -> bool:
        """Whether every invariant held in every fault and between them, and no acknowledged message was lost."""
        safe = self.collisions == 0 and self.stale_actions == 0
        return safe and all(outcome.held for outcome in self.outcomes) and self.recorded >= self.acknowledged


def joined(parts: Sequence[Campaign]) -> Campaign:
    """What came of several fleets, one after another."""
    outcomes = tuple(outcome for part in parts for outcome in part.outcomes)
    sums = {item.name: sum(getattr(part, item.name) for part in parts) for item in fields(Campaign)[1:]}
    return Campaign(outcomes, **sums)
