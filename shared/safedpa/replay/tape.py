"""A recording of one robot, sorted for replay: states by tick, and the outputs of each service in their order.

``gaps_of`` finds messages that did not reach the recorder, from gaps in ticks and step counts.

A recording keeps the order of the messages of one sender, but not of different senders.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from dataclasses import fields as dataclass_fields
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec

from safedpa.bus import (
    LATENT,
    NO_ROBOT,
    NOMINAL,
    SURROUNDINGS,
    VERDICT,
    ActionMessage,
    AskedMessage,
    ComputedMessage,
    LatentMessage,
    Message,
    ModelMessage,
    NominalMessage,
    ScanMessage,
    SetupMessage,
    StateMessage,
    SurroundingsMessage,
    TakeoverMessage,
    Topic,
    VerdictMessage,
    decode,
    encode,
    topic_of,
)
from safedpa.errors import InputError, MessageError, RunError, did_you_mean
from safedpa.limits import parse_json
from safedpa.perception import PerceptionNode
from safedpa.policy import PolicyNode
from safedpa.records import Finding
from safedpa.records.earlier_format import without_removed_settings
from safedpa.records.readers.mcap import read_payloads
from safedpa.runtime.node import SafetyFilterNode

Stamp = tuple[int, int]
"""Epoch and tick."""

_SENDERS: dict[type[Message], tuple[str, Topic]] = {
    LatentMessage: ("adaptation", LATENT),
    NominalMessage: ("policy", NOMINAL),
    VerdictMessage: ("safety_filter", VERDICT),
    SurroundingsMessage: (PerceptionNode.name, SURROUNDINGS),
}


_INPUTS: dict[str, tuple[Topic, ...]] = {
    PolicyNode.name: PolicyNode.inputs,
    SafetyFilterNode.name: (*SafetyFilterNode.inputs, *SafetyFilterNode.sensor_inputs),
}


_FIELDS = msgspec.msgpack.Decoder(dict[str, msgspec.Raw])
_MAX_ANSWERS = 8
"""Actions of one tick among which a repetition is searched: two processes may answer the same tick."""


@dataclass(frozen=True, slots=True)
class RecordedMessage:
    """A message of a service, and its log time ``at`` [ns since 1970]."""

    at: int
    message: ComputedMessage


@dataclass
class RobotTape:
    """Recorded messages of one robot."""

    robot: str
    files: tuple[Path, ...]
    states: dict[Stamp, StateMessage] = field(default_factory=dict)
    computed: dict[str, list[RecordedMessage]] = field(
        default_factory=lambda: {name: [] for name, _ in _SENDERS.values()}
    )
    """Outputs by service, each step once, in order."""
    actions: dict[Stamp, list[ActionMessage]] = field(default_factory=dict)
    named: dict[tuple[Topic, int, int, float], ComputedMessage] = field(default_factory=dict)
    """By topic, epoch, tick and publish time: a restarted service may answer a tick again."""
    newest: dict[tuple[Topic, int, int], ComputedMessage] = field(default_factory=dict)
    """Latest message by topic, epoch and tick."""
    models: list[ModelMessage] = field(default_factory=list)
    takeovers: dict[str, list[TakeoverMessage]] = field(default_factory=dict)
    setups: dict[str, list[tuple[int, SetupMessage]]] = field(default_factory=dict)
    """(log time, setup) by service, each process once."""
    asked: list[AskedMessage] = field(default_factory=list)
    scans: dict[tuple[int, str, int], bytes] = field(default_factory=dict)
    """Encoded scans by epoch, source and number; decoded they would take four times the memory."""
    fields: dict[type[Message], frozenset[str]] = field(default_factory=dict)
    """Fields of the recorded messages by type; older programs have fewer."""
    findings: list[Finding] = field(default_factory=list)
    _instances: dict[str, set[str]] = field(default_factory=lambda: defaultdict(set))
    """Processes of each service whose setup is known."""

    def add(self, at: int, message: Message) -> None:
        """Adds one message; repetitions are ignored."""
        stamp = (message.epoch, message.tick)
        if isinstance(message, StateMessage):
            self.states.setdefault(stamp, message)
        elif isinstance(message, ActionMessage):
            known = self.actions.setdefault(stamp, [])
            if message not in known[-_MAX_ANSWERS:]:
                known.append(message)
        elif isinstance(message, ComputedMessage):
            self._add_computed(at, message)
        elif isinstance(message, ModelMessage):
            self.models.append(message)
        elif isinstance(message, TakeoverMessage):
            self.takeovers.setdefault(message.service, []).append(message)
        elif isinstance(message, AskedMessage):
            self.asked.append(message)
        elif isinstance(message, ScanMessage):
            self.scans[message.epoch, message.source, message.number] = encode(message)

    def scan(self, key: tuple[int, str, int]) -> ScanMessage | None:
        """Returns a scan by epoch, source and number; None if it was not recorded."""
        payload = self.scans.get(key)
        return None if payload is None else decode(ScanMessage, payload)

    def _add_computed(self, at: int, message: ComputedMessage) -> None:
        sender, topic = _SENDERS[type(message)]
        message = self._without_invalid_trace(sender, message)
        entries = self.computed[sender]
        if entries and entries[-1].message.publish_time == message.publish_time and entries[-1].message == message:
            return
        entries.append(RecordedMessage(at, message))
        self.named[topic, message.epoch, message.tick, message.publish_time] = message
        self.newest[topic, message.epoch, message.tick] = message

    def _without_invalid_trace(self, sender: str, message: ComputedMessage) -> ComputedMessage:
        """Removes the trace of the inputs if it does not have one age and time for each; they are then unknown."""
        rows, most = message.consumed, len(_INPUTS.get(sender, ()))
        wanted = (
            most - len(SafetyFilterNode.sensor_inputs) if sender == SafetyFilterNode.name else most
        )  # without sources
        if not rows or (len(rows) in (wanted, most) and all(len(row) == 2 for row in rows)):
            return message
        text = f"{sender}: its trace of inputs does not have one age and time for each of {wanted}; ignored"
        if all(finding.message != text for finding in self.findings):
            self.findings.append(Finding("unreadable_trace", text))
        return replace(message, consumed=())

    def add_setup(self, at: int, setup: SetupMessage) -> None:
        """Adds the setup of a process, without settings that only older programs have; these become a finding."""
        known = self.setups.setdefault(setup.service, [])
        if setup.instance in self._instances[setup.service]:
            return
        self._instances[setup.service].add(setup.instance)
        settings, removed = without_removed_settings(setup.settings)
        known.append((at, replace(setup, settings=settings)))
        message = f"{', '.join(removed)}: recorded, but these settings no longer exist; ignored"
        if removed and all(finding.message != message for finding in self.findings):
            self.findings.append(Finding("former_settings", message, len(removed)))

    def absent(self, topic: Topic) -> set[Stamp]:
        """Epochs and ticks of messages that other services report as used but that are not in the recording."""
        found: set[Stamp] = set()
        for service, inputs in _INPUTS.items():
            if topic not in inputs:
                continue
            index = inputs.index(topic)
            for message in (entry.message for entry in self.computed[service]):
                if index >= len(message.consumed) or message.consumed[index][1] == 0.0:
                    continue
                age, published = message.consumed[index]
                tick = message.tick - int(age)
                if (topic, message.epoch, tick, published) not in self.named:
                    found.add((message.epoch, tick))
        return found

    def seconds(self) -> tuple[float, float]:
        """First and last robot time [s]."""
        times = [state.robot_time for state in self.states.values()]
        return min(times), max(times)


def files_of(runs: Sequence[Path]) -> tuple[Path, ...]:
    """Expands folders to their recordings, oldest first; raises RunError for a folder without a recording."""
    found: list[Path] = []
    for run in runs:
        inside = sorted(run.glob("*.mcap"), key=lambda path: (len(path.stem), path.stem)) if run.is_dir() else [run]
        if not inside:
            raise RunError(f"{run}: no recording (.mcap) in it; name the folder of a run, or a recording")
        found += inside
    return tuple(found)


def read_tape(runs: Sequence[Path], robot: str | None = None) -> RobotTape:
    """What the recordings hold of one robot. Raises RunError when they hold none, or several and none was named."""
    files = files_of(runs)
    tapes: dict[str, RobotTape] = {}
    setups: list[tuple[int, str, SetupMessage]] = []
    findings: list[Finding] = []
    fields: dict[type[Message], frozenset[str]] = {}
    others: set[str] = set()
    """Robots that no one asked for; their messages are not even decoded."""
    for name, at, message in _messages(files, robot, others, findings, fields):
        if isinstance(message, SetupMessage):
            setups.append((at, name, message))
        else:
            tapes.setdefault(name, RobotTape(name, files)).add(at, message)
    tape = _select(files, {name: tape for name, tape in tapes.items() if tape.states}, robot, others)
    tape.fields, tape.findings = fields, [*findings, *tape.findings]
    for at, name, setup in setups:
        if name == tape.robot or options_of(setup).get("robot", "*") in ("*", tape.robot):
            tape.add_setup(at, setup)
    return tape


def options_of(setup: SetupMessage) -> dict[str, Any]:
    """Command-line options of a process; empty if they are unreadable."""
    try:
        options = parse_json(setup.options)
    except InputError:
        return {}
    return options if isinstance(options, dict) else {}


def _messages(
    files: Iterable[Path],
    robot: str | None,
    others: set[str],
    findings: list[Finding],
    fields: dict[type[Message], frozenset[str]],
) -> Iterator[tuple[str, int, Message]]:
    """Yields (robot, log time, message) of all files, for ``robot`` and the services, or for all robots."""
    refused = 0
    for path in files:
        for key, at, topic, payload in read_payloads(path, findings):
            name = topic_of(key)[1]
            if robot is not None and name not in (robot, NO_ROBOT):
                others.add(name)
                continue
            try:
                message = decode(topic.message, payload)
            except MessageError:
                refused += 1
                continue
            _note_fields(fields, topic, payload)
            yield name, at, message
    if refused:
        findings.append(Finding("unreadable_message", f"{refused} messages could not be decoded; ignored", refused))


def _note_fields(fields: dict[type[Message], frozenset[str]], topic: Topic, payload: bytes) -> None:
    if topic.message not in fields:
        try:
            fields[topic.message] = frozenset(_FIELDS.decode(payload))  # only the names are decoded
        except (msgspec.DecodeError, UnicodeDecodeError):  # foreign fields whose names are not text
            fields[topic.message] = frozenset(item.name for item in dataclass_fields(topic.message))


def _select(files: tuple[Path, ...], tapes: dict[str, RobotTape], robot: str | None, others: set[str]) -> RobotTape:
    where = files[0] if len(files) == 1 else f"{files[0]} and {len(files) - 1} more"
    if not tapes and not others:
        raise RunError(f"{where}: contains no state of a robot; wanted a recording of a drive")
    if robot is None and len(tapes) > 1:
        raise RunError(f"{where}: holds {len(tapes)} robots: {', '.join(sorted(tapes))}; name one with --robot")
    if robot is not None and robot not in tapes:
        raise RunError(f"{where}: robot '{robot}': {did_you_mean(robot, {*tapes, *others})}")
    return tapes[robot] if robot is not None else next(iter(tapes.values()))


@dataclass(frozen=True)
class TickGap:
    """A range of ticks in which messages of one kind are missing."""

    what: str
    """``state``, or the service whose outputs are missing."""
    epoch: int
    after_tick: int
    before_tick: int
    missing: int

    @property
    def sentence(self) -> str:
        """A sentence that describes the gap."""
        kind = "states" if self.what == "state" else f"outputs of {self.what}"
        return f"{self.missing} {kind} between tick {self.after_tick} and tick {self.before_tick}"


def gaps_of(tape: RobotTape) -> list[TickGap]:
    """Returns every gap, states first.

    A robot counts its periods, so a missing tick is a lost state (or a period in which its process was delayed). A
    service counts its steps, so a missing number is a lost output. A lost last output is found if another service
    reports that it used it.
    """
    outputs = [gap for service in tape.computed for gap in _output_gaps(tape, service)]
    used = (("adaptation", LATENT), ("policy", NOMINAL))
    at_end = [gap for service, topic in used for gap in _lost_at_end(tape, service, topic)]
    return [*_state_gaps(tape), *outputs, *at_end]


def _state_gaps(tape: RobotTape) -> Iterator[TickGap]:
    stamps = sorted(tape.states)
    for (epoch, tick), (following_epoch, following) in pairwise(stamps):
        if epoch == following_epoch and following > tick + 1:
            yield TickGap("state", epoch, tick, following, following - tick - 1)


def _output_gaps(tape: RobotTape, service: str) -> Iterator[TickGap]:
    messages = [entry.message for entry in tape.computed[service]]
    for before, after in pairwise(messages):
        missing = after.step - before.step - 1
        if before.epoch == after.epoch and before.step and missing > 0:
            yield TickGap(service, after.epoch, before.tick, after.tick, missing)


def _lost_at_end(tape: RobotTape, service: str, topic: Topic) -> Iterator[TickGap]:
    """Outputs after the last recorded one that other services report as used."""
    last = {entry.message.epoch: entry.message.tick for entry in tape.computed[service]}
    lost: dict[int, list[int]] = defaultdict(list)
    for epoch, tick in tape.absent(topic):
        if tick > last.get(epoch, -1):
            lost[epoch].append(tick)
    for epoch, ticks in sorted(lost.items()):
        yield TickGap(service, epoch, last.get(epoch, -1), max(ticks) + 1, len(ticks))
