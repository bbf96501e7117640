"""What a replay gave, as a file: a table, or a recording like the one that was replayed."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from safedpa.bus import MODEL, SETUP, STATE, ComputedMessage, Message, Topic, encode, key_of
from safedpa.errors import InputError
from safedpa.records import McapRecorder
from safedpa.replay.driver import Driven
from safedpa.replay.tape import Tape
from safedpa.replay.what_if import Decision

__all__ = ["Saved", "write_decisions"]

_COLUMNS = ("status", "h_now", "h_next", "margin", "slack")


class Saved:
    """Collects what came out, and writes it."""

    def __init__(self) -> None:
        self._steps: list[Driven] = []

    def take(self, step: Driven) -> None:
        """Hears of one step."""
        self._steps.append(step)

    def leave(self, step: Driven) -> None:
        """Hears of one step that nobody wants to keep."""

    def write(self, tape: Tape, path: Path) -> None:
        """The recorded states and setups with the replayed outputs, as a recording that can be replayed itself.

        Raises InputError unless the file is to be an .mcap.
        """
        if path.suffix != ".mcap":
            raise InputError(f"--out {path}: got no .mcap; a table (.csv) is for --model, --eta and --margin")
        with McapRecorder(path) as recorder:
            for at, topic, message in sorted(self._messages(tape), key=lambda item: item[0]):
                key = key_of("replay", tape.robot, topic, getattr(message, "service", ""))
                recorder.write(key, encode(message), at, _nanoseconds(message))

    def _messages(self, tape: Tape) -> Iterable[tuple[int, Topic, Message]]:
        """Log time, topic and message."""
        yield from ((at, SETUP, setup) for setups in tape.setups.values() for at, setup in setups)
        yield from ((_nanoseconds(message), MODEL, message) for message in tape.models)
        yield from ((_nanoseconds(state), STATE, state) for state in tape.states.values())
        for step in self._steps:
            for topic, message in step.outputs.items():
                traced = _traced(message, step.recorded)
                yield _nanoseconds(traced), topic, traced


def _traced(message: Message, recorded: ComputedMessage | None) -> Message:
    """The message with the time and the inputs of the recorded one."""
    if recorded is None:
        return message
    message = replace(message, publish_time=recorded.publish_time)
    if not isinstance(message, ComputedMessage):
        return message
    return replace(message, step=recorded.step, consumed=recorded.consumed, skipped=recorded.skipped)


def _nanoseconds(message: Message) -> int:
    return round(1e9 * message.publish_time)


def write_decisions(decisions: Sequence[Decision], path: Path) -> None:
    """One row a tick: what was decided then, and what would have been now. Raises InputError unless it is a .csv."""
    if path.suffix != ".csv":
        raise InputError(f"--out {path}: got no .csv; decisions under another model or margin are a table")
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
