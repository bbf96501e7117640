"""Reports of a replay as text and JSON, and its outputs as a table or a recording."""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, replace
from math import isfinite
from pathlib import Path
from typing import Any

from safedpa.bus import (
    MODEL,
    SCAN,
    SETUP,
    STATE,
    SURROUNDINGS,
    ComputedMessage,
    Message,
    SurroundingsMessage,
    Topic,
    VerdictMessage,
    encode,
    key_of,
)
from safedpa.errors import InputError
from safedpa.perception import PerceptionNode
from safedpa.records import McapRecorder
from safedpa.replay.driver import ReplayedStep
from safedpa.replay.replay import Replay, ServiceReplay, UnknownStateSpan
from safedpa.replay.tape import RobotTape, TickGap
from safedpa.replay.what_if import DecisionPair, WhatIfSummary

_MAX_SHOWN = 10


def lines_of(tape: RobotTape, found: Replay, gaps: list[TickGap], assumed: list[str]) -> Iterator[str]:
    """Lines of a report: agreement, or the first differences."""
    (begin, end), files = tape.seconds(), ", ".join(map(str, tape.files))
    yield f"robot '{tape.robot}': {len(tape.states)} states, {begin:.2f} to {end:.2f} s, from {files}"
    yield from note_lines(tape, assumed)
    yield from (f"  not recorded: {gap.sentence}" for gap in gaps)
    yield from _verdict_lines(tape)
    for part in found.services:
        yield from _service_lines(part)
    differing = sorted(
        (item for part in found.services for item in part.differing), key=lambda item: (item.robot_time, item.tick)
    )
    for item in differing[:_MAX_SHOWN]:
        yield (
            f"  tick {item.tick} ({item.robot_time:.2f} s) {item.topic}.{item.field}: "
            f"recorded {_short(item.recorded)}, replayed {_short(item.replayed)}"
        )
    if len(differing) > _MAX_SHOWN:
        yield f"  ... and {len(differing) - _MAX_SHOWN} more fields"
    yield _conclusion(found)


def note_lines(tape: RobotTape, assumed: list[str]) -> Iterator[str]:
    """Lines with findings about the recording and the assumptions that replace missing data."""
    yield from (f"  {finding.kind}: {finding.message}" for finding in tape.findings)
    yield from (f"  assumed: {sentence}" for sentence in assumed)


def recorded_verdicts(tape: RobotTape) -> tuple[dict[str, int], float | None]:
    """Returns how many recorded verdicts have each status, and their smallest h now; None without a known h."""
    verdicts = [item.message for item in tape.computed["safety_filter"] if isinstance(item.message, VerdictMessage)]
    known = [verdict.h_now for verdict in verdicts if isfinite(verdict.h_now) and not _is_placeholder(verdict)]
    return dict(Counter(verdict.status for verdict in verdicts).most_common()), min(known, default=None)


def braked_by_watchdog(tape: RobotTape) -> int:
    """Returns in how many recorded periods no action arrived in time, so that the robot braked by itself."""
    return sum(state.applied_by == "watchdog" for state in tape.states.values())


def _is_placeholder(verdict: VerdictMessage) -> bool:
    """Whether h could not be computed, such as before the first latent."""
    return verdict.status == "fallback" and verdict.h_now == verdict.h_next == 0.0


def _verdict_lines(tape: RobotTape) -> Iterator[str]:
    counts, least = recorded_verdicts(tape)
    if counts:
        known = "h not known" if least is None else f"smallest h_now {least:.3g}"
        yield f"  verdicts       {', '.join(f'{count} {status}' for status, count in counts.items())}; {known}"
        yield f"  watchdog       {braked_by_watchdog(tape)} of {len(tape.states)} periods without an action in time"


def _service_lines(part: ServiceReplay) -> Iterator[str]:
    counts = ", ".join(
        f"{topic} {part.identical[topic]} of {count} identical" for topic, count in part.compared.items()
    )
    yield f"  {part.service:<14} {counts or 'nothing to compare'}" + (f"; {part.lost} recomputed" if part.lost else "")
    yield from (f"    {_span_sentence(span)}" for span in part.spans)


def _span_sentence(span: UnknownStateSpan) -> str:
    unknown = f"memory not known from tick {span.tick} on ({span.reason}): {span.steps} outputs not compared"
    if span.agrees_from is not None:
        return f"{unknown}, agrees again from tick {span.agrees_from} on"
    if span.again_from is not None:
        return f"{unknown}, known again from tick {span.again_from} on, where it restarted"
    return f"{unknown}, never agreed again"


def _conclusion(found: Replay) -> str:
    if not any(part.compared for part in found.services):
        return "nothing was compared: there is no recorded output of a service, or none with a known memory"
    if found.exact:
        return "identical: every field of every message that can be compared, bit for bit"
    if found.agrees:
        rounded = sum(part.rounded for part in found.services)
        return f"equal within the tolerance: {rounded} fields differ in last digits"
    if any(part.differing for part in found.services):
        return "DIFFERENT"
    return "not confirmed: data are missing, so the memory of a service is unknown to the end"


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 100 else text[:97] + "..."


def document_of(tape: RobotTape, found: Replay, gaps: list[TickGap], assumed: list[str]) -> dict[str, Any]:
    """JSON document of a replay."""
    begin, end = tape.seconds()
    counts, least = recorded_verdicts(tape)
    return {
        "format": 1,
        "robot": tape.robot,
        "files": [str(path) for path in tape.files],
        "states": len(tape.states),
        "seconds": [begin, end],
        "verdicts": counts,
        "least_h_now": least,
        "braked_by_watchdog": braked_by_watchdog(tape),
        "agrees": found.agrees,
        "exact": found.exact,
        "assumed": assumed,
        "findings": [asdict(finding) for finding in tape.findings],
        "not_recorded": [asdict(gap) for gap in gaps],
        "services": [asdict(part) | {"differing": len(part.differing)} for part in found.services],
        "differences": [asdict(item) for part in found.services for item in part.differing[:100]],
    }


def what_if_lines(summary: WhatIfSummary, decisions: list[DecisionPair], changed: str) -> Iterator[str]:
    """Lines about how the decisions of the other filter differ, with the first differences."""
    yield f"  what if {changed}: {summary.ticks} decisions on the RECORDED states (open loop: the"
    yield "  consequences of other actions are not included; --closed-loop simulates the drive again)"
    for status in sorted({*summary.status_then, *summary.status_now}):
        before, after = summary.status_then.get(status, 0), summary.status_now.get(status, 0)
        yield f"    {status:<10} then {before:>6}   now {after:>6}"
    yield f"    smallest h of the recorded states {summary.smallest_h_now:.4f}"
    yield f"    smallest h predicted: then {summary.smallest_h_then:.4f}   now {summary.smallest_h_other:.4f}"
    yield (
        f"    decided differently in {summary.differing} of {summary.ticks} ticks, by at most "
        f"{summary.largest_distance:.4f} (at {summary.largest_distance_at:.2f} s)"
    )
    differing = [decision for decision in decisions if decision.differs]
    for decision in differing[:_MAX_SHOWN]:
        then, now = decision.then, decision.now
        yield (
            f"    tick {then.tick} ({then.robot_time:.2f} s): then {then.status} {_numbers(then.action)} h "
            f"{then.h_next:.4f}; now {now.status} {_numbers(now.action)} h {now.h_next:.4f}"
        )
    if len(differing) > _MAX_SHOWN:
        yield f"    ... and {len(differing) - _MAX_SHOWN} more; --out FILE.csv has every tick"


def _numbers(action: tuple[float, ...]) -> str:
    return "(" + ", ".join(f"{value:.3f}" for value in action) + ")"


def what_if_document(summary: WhatIfSummary, decisions: list[DecisionPair], changed: str) -> dict[str, Any]:
    """JSON document of a what-if, with every tick that is decided differently."""
    return {
        "changed": changed,
        "states": "recorded (open loop)",
        "summary": asdict(summary),
        "differing": [
            {
                "epoch": decision.then.epoch,
                "tick": decision.then.tick,
                "robot_time": decision.then.robot_time,
                "then": _side(decision, now=False),
                "now": _side(decision, now=True),
            }
            for decision in decisions
            if decision.differs
        ],
    }


def _side(decision: DecisionPair, *, now: bool) -> dict[str, Any]:
    verdict = decision.now if now else decision.then
    return {
        "status": verdict.status,
        "action": list(verdict.action),
        "h_now": verdict.h_now,
        "h_next": verdict.h_next,
        "margin": verdict.margin,
        "slack": verdict.slack,
    }


_COLUMNS = ("status", "h_now", "h_next", "margin", "slack")


def write_outputs(tape: RobotTape, steps: Sequence[ReplayedStep], path: Path) -> None:
    """Writes recorded states and setups with the replayed outputs, as a recording that can be replayed itself.

    Raises InputError unless ``path`` ends in .mcap.
    """
    if path.suffix != ".mcap":
        raise InputError(f"--out {path}: wanted .mcap; a table (.csv) is written with --model, --eta or --margin")
    with McapRecorder(path) as recorder:
        for at, topic, message in sorted(_output_messages(tape, steps), key=lambda item: item[0]):
            key = key_of("replay", tape.robot, topic, getattr(message, "service", ""))
            recorder.write(key, encode(message), at, _nanoseconds(message))


def _output_messages(tape: RobotTape, steps: Sequence[ReplayedStep]) -> Iterable[tuple[int, Topic, Message]]:
    """Yields log time, topic and message; outputs of perception are the recorded ones if it was not replayed."""
    yield from ((at, SETUP, setup) for setups in tape.setups.values() for at, setup in setups)
    yield from ((_nanoseconds(message), MODEL, message) for message in tape.models)
    yield from ((_nanoseconds(state), STATE, state) for state in tape.states.values())
    yield from ((_nanoseconds(scan), SCAN, scan) for scan in map(tape.scan, tape.scans) if scan is not None)
    if not any(isinstance(step.recorded, SurroundingsMessage) for step in steps):
        recorded = (entry.message for entry in tape.computed[PerceptionNode.name])
        yield from ((_nanoseconds(message), SURROUNDINGS, message) for message in recorded)
    for step in steps:
        for topic, message in step.outputs.items():
            traced = _traced(message, step.recorded)
            yield _nanoseconds(traced), topic, traced


def _traced(message: Message, recorded: ComputedMessage | None) -> Message:
    """The message with the time and the trace of inputs of the recorded one."""
    if recorded is None:
        return message
    message = replace(message, publish_time=recorded.publish_time)
    if not isinstance(message, ComputedMessage):
        return message
    return replace(message, step=recorded.step, consumed=recorded.consumed, skipped=recorded.skipped)


def _nanoseconds(message: Message) -> int:
    return round(1e9 * message.publish_time)


def write_decisions(decisions: Sequence[DecisionPair], path: Path) -> None:
    """Writes one row for each tick with both decisions; raises InputError unless ``path`` ends in .csv."""
    if path.suffix != ".csv":
        raise InputError(f"--out {path}: wanted .csv; decisions with another model or margin are a table")
    width = max((len(decision.then.action) for decision in decisions), default=0)
    actions = [f"action_{index}" for index in range(width)]
    sides = [f"{name}_{side}" for side in ("then", "now") for name in (*_COLUMNS, *actions)]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["epoch", "tick", "t", *sides])
        for item in decisions:
            values = [
                value
                for verdict in (item.then, item.now)
                for value in (*(getattr(verdict, name) for name in _COLUMNS), *verdict.action)
            ]
            writer.writerow([item.then.epoch, item.then.tick, item.then.robot_time, *values])
