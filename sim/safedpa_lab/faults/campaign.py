"""Runs faults one after another on driving fleets, and says of each what it did."""

from __future__ import annotations

import math
import random
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

from safedpa_lab.faults.episode import (
    Campaign,
    Episode,
    Evidence,
    Outcome,
    Recorded,
    collisions_in,
    joined,
    read_recorded,
    recovery_of,
    stale_in,
)
from safedpa_lab.faults.fault import Fault
from safedpa_lab.faults.world import DISK_BYTES, ROBOT, World, WorldSettings
from safedpa_sim.robots.run_summary import TracedPeriod, read_trace

DEFAULT_SEED = 9
"""A scene in which the car is seldom slower than a fault wants it for more than a few seconds."""
_PERIOD = 0.05
_FAST = 1.0
"""m/s; a fault comes while the car is at least this fast,"""
_FAST_PATIENCE_SECONDS = 6.0
"""and a car that is not after so long is put back to its start."""
_DRIVING_PATIENCE_SECONDS = 20.0
_AFTERWARDS_SECONDS = 1.0
"""Driving that still belongs to the fault."""
_HASTE_SECONDS = 1.5
_FLUSH_SECONDS = 0.7
"""The recorder writes within half a second."""
_FAULTS_OF_A_DISK = 100
_LARGEST_DISTURBED_SHARE = 0.1
"""Of periods, where the loop must not notice: a busy machine costs one now and then."""
_LEAST_DRIVEN_SHARE = 0.3
"""Of periods, where it must go on driving."""


@dataclass(frozen=True)
class _Lived:
    """A fault that is over, before its world has ended."""

    fault: Fault
    episode: Episode
    speed: float
    back: float | None
    """s until every process was heard again."""
    troubles: tuple[str, ...]
    """What was not as it must be; empty ones are none."""


def run_faults(
    faults: Sequence[Fault],
    seed: int = DEFAULT_SEED,
    folder: Path | None = None,
    report_progress: Callable[[str, int, int], None] = lambda _name, _done, _all: None,
    *,
    is_hasty: bool = False,
    seconds: float = math.inf,
    alongside: Callable[[World], AbstractContextManager[object]] = nullcontext,
) -> Campaign:
    """Every fault in turn, on one fleet as long as it drives on; a fleet that does not recover is replaced.

    ``folder`` keeps what the processes wrote. ``is_hasty``: faults last at most 1.5 s and hardly wait for the car to be
    fast. After so many ``seconds`` no other fault begins. ``alongside`` is entered with each fleet. Raises SafedpaError
    when a fleet does not come up at all.
    """
    end = time.monotonic() + seconds
    parts: list[Campaign] = []
    waiting = (
        [replace(fault, seconds=min(fault.seconds, _HASTE_SECONDS)) for fault in faults] if is_hasty else list(faults)
    )
    with tempfile.TemporaryDirectory(prefix="safedpa-faults-") as own:
        while waiting and (not parts or time.monotonic() < end):
            done = len(faults) - len(waiting)
            settings = WorldSettings(
                seed=seed + len(parts),
                diagnosis=waiting[0].diagnosis,
                disk_bytes=DISK_BYTES * max(1, -(-len(waiting) // _FAULTS_OF_A_DISK)),
            )
            world = World((folder or Path(own)) / f"world-{len(parts)}", settings)
            lived: list[_Lived] = []
            with world, alongside(world):
                for fault in waiting:
                    if fault.diagnosis != settings.diagnosis or (lived and time.monotonic() >= end):
                        break
                    report_progress(fault.name, done + len(lived), len(faults))
                    lived.append(_run(fault, world, is_hasty=is_hasty))
                    if lived[-1].back is None or not world.drives():
                        break
            waiting = waiting[len(lived) :]
            parts.append(_judged(world, lived))
    return joined(parts)


def _run(fault: Fault, world: World, *, is_hasty: bool) -> _Lived:
    fault.set_up(world)
    _drive_off(fault, world, is_hasty=is_hasty)
    speed, struck = _speed(world), time.monotonic()
    try:
        fault.strike(world)
        world.listen(fault.seconds)
        seen = fault.look(world)
    finally:  # whatever happens here, nothing that a fault started stays on the machine
        corrected = time.monotonic()
        fault.repair(world)
    whole = world.until(lambda: not world.missing(corrected), fault.recovers_within)
    absent = [] if whole else [f"{name} is not back, {world.members[name].fate()}" for name in world.missing(corrected)]
    back = time.monotonic() - corrected if whole else None
    world.until(lambda: world.drives(corrected), fault.recovers_within)
    checked = fault.check(world, Episode(struck, corrected, time.monotonic()))
    world.listen(_AFTERWARDS_SECONDS)
    # Where the machine held everyone up just now, the end of that is still to be seen: else it would look as for good.
    world.until(world.drives_steadily, fault.recovers_within)
    lived = _Lived(fault, Episode(struck, corrected, time.monotonic()), speed, back, (*absent, seen, checked))
    world.listen(_FLUSH_SECONDS)  # what the recorder has heard of this fault must not be lost by the next one
    fault.clean_up(world)
    world.until(world.drives, _DRIVING_PATIENCE_SECONDS)
    return lived


def _drive_off(fault: Fault, world: World, *, is_hasty: bool) -> None:
    """Returns at some moment of a period in which everything runs and the car is fast."""
    world.until(lambda: not world.missing(0.0) and world.drives(), _DRIVING_PATIENCE_SECONDS)
    patience = _HASTE_SECONDS if is_hasty else _FAST_PATIENCE_SECONDS
    if not world.until(lambda: _is_fast(world), patience) and not is_hasty:
        world.members["robot"].restart()  # it stands somewhere; from its start it drives off at once
        world.until(lambda: _is_fast(world), _DRIVING_PATIENCE_SECONDS)
    world.listen(random.Random(f"{world.settings.seed} {fault.name}").uniform(0.0, _PERIOD))


def _is_fast(world: World) -> bool:
    return _speed(world) >= _FAST and world.drives()


def _speed(world: World) -> float:
    state = world.observer.states.get(world.observer.newest)
    return 0.0 if state is None else float(state.values[3])


def _judged(world: World, lived: Sequence[_Lived]) -> Campaign:
    """After the world has ended: the trace is whole and the recordings are closed."""
    observer, recorded = world.observer, read_recorded(world.recordings, ROBOT)
    periods = list(read_trace(world.trace))
    evidence = Evidence(periods, observer.verdicts, observer.actions, _PERIOD)
    return Campaign(
        outcomes=tuple(_outcome(one, evidence, recorded) for one in lived),
        periods=len(periods),
        collisions=collisions_in(periods),
        stale_actions=len(stale_in(periods, evidence)),
        acknowledged=sum(observer.acknowledged.values()),
        recorded=recorded.messages,
    )


def _outcome(lived: _Lived, evidence: Evidence, recorded: Recorded) -> Outcome:
    fault, episode = lived.fault, lived.episode
    periods = evidence.within(episode.struck, episode.ended)
    stamps = {(one.epoch, one.tick) for one in periods}
    lost = recorded.lost(stamps, stamps & set(evidence.verdicts))
    recovery = recovery_of(evidence, episode)
    stale = stale_in(periods, evidence)
    collisions = collisions_in(periods)
    broken = [f"{collisions} collisions"] if collisions else []
    broken += stale[:3]
    if recovery is None or recovery > fault.recovers_within:
        broken.append(f"does not drive {fault.recovers_within:.0f} s after the recovery")
    broken += [phrase for phrase in (*lived.troubles, _meanwhile(fault, episode, evidence)) if phrase]
    return Outcome(
        name=fault.name,
        sentence=fault.sentence,
        held=not broken,
        broken=tuple(broken),
        speed=round(lived.speed, 2),
        collisions=collisions,
        stale_actions=len(stale),
        periods=len(periods),
        watchdog=sum(one.applied_by == "watchdog" for one in periods),
        fallbacks=sum(one.applied_by == "filter" and evidence.is_fallback(one) for one in periods),
        recovery_seconds=None if recovery is None else round(recovery, 3),
        whole_seconds=None if lived.back is None else round(lived.back, 3),
        states_not_recorded=lost[0],
        verdicts_not_recorded=lost[1],
    )


def _meanwhile(fault: Fault, episode: Episode, evidence: Evidence) -> str:
    """How what the loop had to do during the fault was missed; empty when it was not."""
    end = episode.ended if fault.meanwhile == "undisturbed" else episode.corrected
    during: list[TracedPeriod] = evidence.within(episode.struck, end)
    if fault.meanwhile == "anything" or not during:
        return ""
    share = sum(evidence.is_driven(one) for one in during) / len(during)
    wanted = 1.0 - _LARGEST_DISTURBED_SHARE if fault.meanwhile == "undisturbed" else _LEAST_DRIVEN_SHARE
    return "" if share >= wanted else f"{share:.0%} of the periods were driven, wanted {wanted:.0%}"
