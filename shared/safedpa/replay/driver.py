"""Runs the node of one service through its recorded steps.

Each recorded output names its state, its inputs and the number of its step, so the node is called exactly as by the
loop of the service: ``prepare`` for skipped states, then ``step`` and ``afterwards``; ``forget`` when the robot
restarted, a new node when the process restarted. Model changes are applied at the recorded ticks.
"""

from __future__ import annotations

import contextlib
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, final

from safedpa.bus import (
    AbstractNode,
    Answer,
    ComputedMessage,
    Inputs,
    Message,
    ModelMessage,
    Outputs,
    SetupMessage,
    Stale,
    StateMessage,
    SurroundingsMessage,
    Topic,
    VerdictMessage,
)
from safedpa.bus.messages.messages import header
from safedpa.errors import InputError
from safedpa.perception import PerceptionNode
from safedpa.replay.tape import RecordedMessage, RobotTape, Stamp
from safedpa.runtime.node import SafetyFilterNode

_SETUP_DELAY_NS = 6_000_000_000
"""A process sends its setup every five seconds: a setup recorded so soon after an output may be that of its sender."""
_LOOK_BACK_TICKS = 200


@dataclass(frozen=True)
class ReplayedStep:
    """A recorded step and its replayed outputs."""

    state: StateMessage
    recorded: ComputedMessage | None
    """None for a step whose output was not recorded."""
    outputs: Outputs
    """Empty if the node refused the state."""
    unknown: str = ""
    """Why the memory of the service or an input is unknown from this step on; empty if nothing new is unknown."""
    restarted: bool = False
    """Whether the memory of the service restarted with this step, so that earlier unknowns no longer matter."""


class InputOverride:
    """Replaces what the node sees in a replay. This base class changes nothing."""

    def state(self, state: StateMessage) -> StateMessage:
        """Returns the state that the node sees."""
        return state

    def message(self, recorded: Message) -> Message:
        """Returns the input that the node uses."""
        return recorded

    def done(self, state: StateMessage, outputs: Outputs) -> None:
        """Called with the outputs of each step."""
        del state, outputs


@final
class Driver:
    """Replays one service of one robot. ``build`` makes its node from a setup; its exceptions are passed on.

    ``reconstructed`` collects the outputs of steps that were not recorded, by topic, epoch and tick, as inputs of the
    services downstream.
    """

    def __init__(
        self,
        tape: RobotTape,
        service: str,
        build: Callable[[SetupMessage], AbstractNode],
        override: InputOverride | None = None,
        *,
        follow_models: bool = True,
        reconstructed: dict[tuple[Topic, int, int], Message] | None = None,
    ) -> None:
        self._tape, self._service, self._build = tape, service, build
        self._override = override or InputOverride()
        self._changes = ModelChange(tape, service) if follow_models else None
        self._setups = tape.setups.get(service, [])
        self._setup = -1
        self._reconstructed = {} if reconstructed is None else reconstructed
        self._node: AbstractNode | None = None
        self._previous: ComputedMessage | None = None

    def run(self) -> Iterator[ReplayedStep]:
        """Yields every step, in recorded order."""
        for entry in self._tape.computed[self._service]:
            message = entry.message
            state = self._tape.states.get((message.epoch, message.tick))
            if state is None:
                continue  # its state was not recorded: counts as a missing step
            restarted = self._is_restart(message)
            if restarted:
                unknown = self._start_node(entry)
                yield from (self._step(before, None, "") for before in self._states_before_first(message))
            else:
                lost = self._lost_states(message)
                yield from (self._step(between, None, "") for between in lost)
                unknown = self._gap(message, len(lost))
            yield replace(self._step(state, message, unknown), restarted=restarted)
            self._previous = message
        yield from (self._step(state, None, "") for state in self._states_used_after_end())

    def _states_used_after_end(self) -> list[StateMessage]:
        """States after the last recorded output whose outputs other services report as used."""
        previous = self._previous
        outputs = () if self._node is None else self._node.outputs
        if previous is None:
            return []
        used = {stamp for topic in outputs for stamp in self._tape.absent(topic)}
        last = max((tick for epoch, tick in used if epoch == previous.epoch), default=-1)
        found = []
        for tick in range(previous.tick + 1, last + 1):
            state = self._tape.states.get((previous.epoch, tick))
            if state is None:
                break
            found.append(state)
        return found

    def _is_restart(self, message: ComputedMessage) -> bool:
        """Whether the memory of the service restarted with this step, or nothing is recorded before it."""
        previous = self._previous
        if previous is None or message.epoch != previous.epoch:
            return True
        return 0 < message.step <= previous.step

    def _start_node(self, entry: RecordedMessage) -> str:
        """Builds a new node or clears its memory, as the recorded service did; returns what is unknown."""
        message = entry.message
        if self._node is None or self._is_new_process(entry):
            self._node = self._build(self._setups[self._setup][1])
        else:
            self._node.forget(self._tape.robot)
        missing = ""
        if self._changes is not None:
            missing = self._changes.begin(self._node, self._tape.robot, _model_fingerprint(message))
        first = message.step == 1 if message.step else message.tick == 0
        return missing or ("" if first else f"{_output_count(message.step - 1)} before it not recorded")

    def _states_before_first(self, message: ComputedMessage) -> list[StateMessage]:
        """States of the steps before the first recorded one: assumed to be the last ones, without a gap.

        A process that has just started can send outputs before the recorder is connected to it.
        """
        skipped = set(message.skipped)
        found: list[StateMessage] = []
        tick = message.tick
        while len(found) < message.step - 1:
            tick -= 1
            state = self._tape.states.get((message.epoch, tick))
            if state is None:
                return []
            found += [] if float(tick) in skipped else [state]
        return found[::-1]

    def _is_new_process(self, entry: RecordedMessage) -> bool:
        """Whether a new process of the service has started; then its setup is used."""
        started = [number for number, (at, _) in enumerate(self._setups) if at <= entry.at]
        newest = max(started, default=0)
        if newest > self._setup:
            self._setup = newest
            return True
        previous, following = self._previous, self._setup + 1
        if previous is None or previous.epoch != entry.message.epoch:
            return previous is None
        if following < len(self._setups) and self._setups[following][0] <= entry.at + _SETUP_DELAY_NS:
            self._setup = following
        return True

    def _lost_states(self, message: ComputedMessage) -> list[StateMessage]:
        """States of the steps whose outputs are not in the recording; empty if they are ambiguous."""
        previous = self._previous
        if previous is None or not message.step:
            return []
        skipped = set(message.skipped)
        if message.tick - previous.tick > 1 + len(skipped) + len(self._tape.states):
            return []  # bounds the range below: a corrupt tick can be arbitrarily large
        ticks = [tick for tick in range(previous.tick + 1, message.tick) if float(tick) not in skipped]
        found = [self._tape.states.get((message.epoch, tick)) for tick in ticks]
        known = [state for state in found if state is not None]
        return known if len(known) == len(ticks) == message.step - previous.step - 1 else []

    def _gap(self, message: ComputedMessage, reconstructed: int) -> str:
        previous = self._previous
        missing = message.step - previous.step - 1 - reconstructed if previous is not None and message.step else 0
        return f"{_output_count(missing)} before it not recorded" if missing > 0 else ""

    def _step(self, state: StateMessage, message: ComputedMessage | None, unknown: str) -> ReplayedStep:
        node, robot = self._node, self._tape.robot
        assert node is not None
        for tick in () if message is None else message.skipped:
            skipped = self._tape.states.get((state.epoch, int(tick)))
            if skipped is not None:
                node.prepare(robot, self._override.state(skipped))
        if self._changes is not None and message is not None:
            unknown = unknown or self._changes.follow(node, robot, state, _model_fingerprint(message))
        inputs, missing = self._inputs(node, state, message)
        if isinstance(node, SafetyFilterNode) and isinstance(message, VerdictMessage):
            node.orders.replay(robot, message.ordered)
        if isinstance(node, PerceptionNode):
            missing = missing or self._replay_scans(node, state, message)
        outputs = self._compute(node, state, inputs)
        self._override.done(state, outputs)
        if message is None:
            self._reconstructed |= {(topic, state.epoch, state.tick): item for topic, item in outputs.items()}
        return ReplayedStep(state, message, outputs, unknown or missing)

    def _replay_scans(self, node: PerceptionNode, state: StateMessage, message: ComputedMessage | None) -> str:
        """Feeds perception the scans that it used, with the recorded overrides; returns what is missing."""
        if not isinstance(message, SurroundingsMessage):
            return "the scans that it used are not recorded"
        node.switches.replay(self._tape.robot, message.off, message.zones, message.ordered)
        missing = ""
        for index, number in message.scans:
            source = state.sources[int(index)] if 0 <= index < len(state.sources) else ""
            scan = self._tape.scan((state.epoch, source, int(number)))
            if scan is None:
                missing = f"scan {number:g} of {source or 'a source that the state does not name'} was not recorded"
                continue
            with contextlib.suppress(InputError):  # as in the loop: an invalid scan is refused
                node.hear(self._tape.robot, scan)
        return missing

    def _compute(self, node: AbstractNode, state: StateMessage, inputs: Inputs) -> dict[Topic, Message]:
        """Runs ``step`` and ``afterwards``; handles their failures like the loop of the service."""
        robot, shown = self._tape.robot, self._override.state(state)
        outputs: dict[Topic, Message] = {}
        try:
            outputs.update(node.step(robot, shown, inputs))
        except Exception as error:  # noqa: BLE001  as in the loop: after any error the node gives a safe output
            reason = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
            return dict(node.rescue(robot, shown, reason))
        if self._changes is not None:
            self._changes.answer(node, robot, shown)
        with contextlib.suppress(Exception):  # as in the loop: the action has been sent already
            outputs.update(node.afterwards(robot))
        return outputs

    def _inputs(self, node: AbstractNode, state: StateMessage, message: ComputedMessage | None) -> tuple[Inputs, str]:
        """Returns the inputs of a step, and which of them is unknown."""
        found: dict[Topic, Message | Stale] = {}
        missing = ""
        for index, topic in enumerate(node.needs(state)):
            trace = message.consumed[index] if message is not None and index < len(message.consumed) else None
            item = self._likely_input(topic, state) if trace is None else self._input_of_trace(topic, state, *trace)
            if item is None:
                item = self._reconstructed.get((topic, state.epoch, state.tick))
            if item is None:
                missing = f"the {topic.name} that it used was not recorded"
                item = self._likely_input(topic, state)
            found[topic] = item if isinstance(item, Stale) else self._override.message(item)
        return found, missing

    def _input_of_trace(
        self, topic: Topic, state: StateMessage, age: float, published: float
    ) -> Message | Stale | None:
        """The input that a step reports as used; None if it was not recorded."""
        if published == 0.0:
            return Stale(topic, None if age < 0 else int(age))
        return self._tape.named.get((topic, state.epoch, state.tick - int(age), published))

    def _likely_input(self, topic: Topic, state: StateMessage) -> Message | Stale:
        """The input that a step without a trace most likely used: that of its tick, if it was recorded."""
        for tick in range(state.tick, max(state.tick - _LOOK_BACK_TICKS, -1), -1):
            item = self._tape.newest.get((topic, state.epoch, tick)) or self._reconstructed.get(
                (topic, state.epoch, tick)
            )
            if item is not None:
                return item if tick == state.tick else Stale(topic, state.tick - tick)
        return Stale(topic, None)


def _model_fingerprint(message: ComputedMessage) -> str:
    """Fingerprint of the model with which a message was computed; empty in recordings of older programs."""
    return str(getattr(message, "model", ""))


def _output_count(count: int) -> str:
    return "some outputs" if count < 1 else f"{count} output{'s' if count > 1 else ''}"


class ModelChange:
    """Applies the recorded model changes to a node.

    An offer is delivered in the tick in which the service answered that it is ready (or refuses); the take is delivered
    before the first output that was computed with the new model. If the text of a model is not in the recording,
    ``follow`` reports it.
    """

    def __init__(self, tape: RobotTape, service: str) -> None:
        self._offers: dict[int, ModelMessage] = {}
        self._takes: dict[int, ModelMessage] = {}
        for message in tape.models:
            known = self._offers if message.step == "offer" else self._takes if message.step == "take" else {}
            known.setdefault(message.change, message)
        self._answers: dict[Stamp, list[tuple[int, str]]] = defaultdict(list)
        for answer in tape.takeovers.get(service, []):
            self._answers[answer.epoch, answer.tick].append((answer.change, answer.state))
        self._texts = {setup.fingerprint: (setup.document, setup.margin) for _, setup in tape.setups.get(service, [])}
        self._prepared = 0
        """Number of the change for which the node is ready; 0 if there is none."""

    def begin(self, node: AbstractNode, robot: str, wanted: str) -> str:
        """Gives a new node the model that was in use; returns what is missing, empty if nothing is."""
        self._prepared = 0
        if wanted and node.model_of(robot) != wanted:
            node.adopt_model(robot, self._status(wanted))
        return self._missing(node, robot, wanted)

    def follow(self, node: AbstractNode, robot: str, state: StateMessage, wanted: str) -> str:
        """Before a step: adopts the model with which it was computed; returns what is missing, empty if nothing is."""
        if not wanted or node.model_of(robot) == wanted:
            return ""
        offer = self._offers.get(self._prepared)
        if offer is not None and offer.fingerprint == wanted:
            node.hear(robot, self._take(offer, state))
            self._prepared = 0
            return ""
        status = self._status(wanted)
        if status is None:
            return self._missing(node, robot, wanted)
        node.adopt_model(robot, _pending(status, state))
        return ""

    def answer(self, node: AbstractNode, robot: str, state: StateMessage) -> None:
        """Before ``afterwards``: delivers the offers that the service answered in that tick."""
        for change, outcome in self._answers.get((state.epoch, state.tick), ()):
            offer = self._offers.get(change)
            if offer is not None and outcome in ("ready", "refused"):
                node.hear(robot, offer)
                self._prepared = change if outcome == "ready" else self._prepared

    def _status(self, fingerprint: str) -> Answer | None:
        """The status of the model in use, as the diagnosis or another service would have sent it."""
        offers = [offer for offer in self._offers.values() if offer.fingerprint == fingerprint]
        if not offers and fingerprint not in self._texts:
            return None
        number = offers[-1].change if offers else 0
        document, margin = (offers[-1].document, offers[-1].margin) if offers else self._texts[fingerprint]
        return Answer(
            ok=True, sentence="as recorded", change=number, fingerprint=fingerprint, document=document, margin=margin
        )

    def _take(self, offer: ModelMessage, state: StateMessage) -> ModelMessage:
        """The recorded take message, or an equivalent one."""
        sent = self._takes.get(offer.change)
        if sent is not None and (sent.epoch != state.epoch or sent.from_tick <= state.tick):
            return sent
        return ModelMessage(
            **header(state),
            step="take",
            change=offer.change,
            fingerprint=offer.fingerprint,
            replaces=offer.replaces,
            from_tick=state.tick,
        )

    def _missing(self, node: AbstractNode, robot: str, wanted: str) -> str:
        found = node.model_of(robot)
        if not wanted or found == wanted:
            return ""
        return f"model {wanted} was in use, and its file is not in the recording (the replay has {found})"


def _pending(status: Answer, state: StateMessage) -> Answer:
    """Converts a status into a pending change to the same model, to be taken now."""
    pending: dict[str, Any] = {
        f"pending_{name}": getattr(status, name) for name in ("fingerprint", "document", "margin")
    }
    none: dict[str, Any] = {"fingerprint": " ", "document": "", "margin": ""}
    return replace(status, pending="take", epoch=state.epoch, from_tick=state.tick, **none, **pending)
