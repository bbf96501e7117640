"""Drives the node of one service again through the steps that a recording says it took.

Each recorded output names the state that it is about, the inputs that the step had, and how many steps went before. So
the node is called as the service's loop called it: ``prepare`` alone for states that were passed over, ``step``,
``afterwards``, ``forget`` when the robot restarted, a new node when the process did, and the steps of a change of
the model where the service answered them.

Which models a recording knows, and when each service answered for them, is read from its changes of the model.
"""

from __future__ import annotations

import contextlib
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import final

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
from safedpa.errors import InputError
from safedpa.perception import PerceptionNode
from safedpa.replay.tape import RecordedMessage, RobotTape, Stamp
from safedpa.runtime.node import SafetyFilterNode

__all__ = ["Driver", "InputOverride", "ModelChange", "ReplayedStep"]

_SETUP_DELAY_NS = 6_000_000_000
"""A process tells its setup every five seconds: one that was recorded so soon after an output may be its sender's."""
_LOOK_BACK_TICKS = 200


@dataclass(frozen=True)
class ReplayedStep:
    """One step: as it was recorded, and as it came out again."""

    state: StateMessage
    recorded: ComputedMessage | None
    """None of a step whose output was lost on the way to the recording."""
    outputs: Outputs
    """Empty when the node refused the state."""
    unknown: str = ""
    """Why the service's memory or an input is not known from this step on; empty where nothing new is unknown."""
    again: bool = False
    """Whether the service's memory of the robot began with this step: what was unknown before matters no more."""


class InputOverride:
    """What the node shall see in place of what was recorded. This one changes nothing."""

    def state(self, state: StateMessage) -> StateMessage:
        """The state to be shown."""
        return state

    def message(self, recorded: Message) -> Message:
        """The input to be used."""
        return recorded

    def done(self, state: StateMessage, outputs: Outputs) -> None:
        """Hears what came out."""
        del state, outputs


@final
class Driver:
    """Replays one service of one robot; ``build`` makes its node from a setup. Raises what ``build`` raises.

    ``made_up`` takes the outputs of steps that were lost on the way to the recording, by topic, epoch and tick, and
    gives them to the services behind.
    """

    def __init__(
        self,
        tape: RobotTape,
        service: str,
        build: Callable[[SetupMessage], AbstractNode],
        overrule: InputOverride | None = None,
        *,
        follow_models: bool = True,
        made_up: dict[tuple[Topic, int, int], Message] | None = None,
    ) -> None:
        self._tape, self._service, self._build = tape, service, build
        self._overrule = overrule or InputOverride()
        self._changes = ModelChange(tape, service) if follow_models else None
        self._setups = tape.setups.get(service, [])
        self._setup = -1
        self._made_up = {} if made_up is None else made_up
        self._node: AbstractNode | None = None
        self._previous: ComputedMessage | None = None

    def run(self) -> Iterator[ReplayedStep]:
        """Every step, in the order of the recording."""
        for entry in self._tape.computed[self._service]:
            message = entry.message
            state = self._tape.states.get((message.epoch, message.tick))
            if state is None:
                continue  # lost on the way to the recording: counts as a missing step
            again = self._is_again(message)
            if again:
                unknown = self._begin(entry)
                yield from (self._step(before, None, "") for before in self._first(message))
            else:
                lost = self._lost(message)
                yield from (self._step(between, None, "") for between in lost)
                unknown = self._gap(message, len(lost))
            yield replace(self._step(state, message, unknown), again=again)
            self._previous = message
        yield from (self._step(state, None, "") for state in self._behind())

    def _behind(self) -> list[StateMessage]:
        """States behind the last recorded output whose outputs other services say they used."""
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

    def _is_again(self, message: ComputedMessage) -> bool:
        """Whether the service's memory of the robot began with this step, or is not in the recording before it."""
        previous = self._previous
        if previous is None or message.epoch != previous.epoch:
            return True
        return 0 < message.step <= previous.step

    def _begin(self, entry: RecordedMessage) -> str:
        """A new node, or a memory made empty, as in the recorded service; returns what is not known."""
        message = entry.message
        if self._node is None or self._is_new_process(entry):
            self._node = self._build(self._setups[self._setup][1])
        else:
            self._node.forget(self._tape.robot)
        missing = ""
        if self._changes is not None:
            missing = self._changes.begin(self._node, self._tape.robot, _model(message))
        first = message.step == 1 if message.step else message.tick == 0
        return missing or ("" if first else f"{_outputs(message.step - 1)} before it not recorded")

    def _first(self, message: ComputedMessage) -> list[StateMessage]:
        """States of the steps before the first recorded one: most likely the last ones, without a gap.

        A process that was started a moment ago may speak before the recorder can hear it.
        """
        passed_over = set(message.skipped)
        found: list[StateMessage] = []
        tick = message.tick
        while len(found) < message.step - 1:
            tick -= 1
            state = self._tape.states.get((message.epoch, tick))
            if state is None:
                return []
            found += [] if float(tick) in passed_over else [state]
        return found[::-1]

    def _is_new_process(self, entry: RecordedMessage) -> bool:
        """Whether another instance of the service had begun; its setup is in force then."""
        begun = [number for number, (at, _) in enumerate(self._setups) if at <= entry.at]
        newest = max(begun, default=0)
        if newest > self._setup:
            self._setup = newest
            return True
        previous, following = self._previous, self._setup + 1
        if previous is None or previous.epoch != entry.message.epoch:
            return previous is None
        if following < len(self._setups) and self._setups[following][0] <= entry.at + _SETUP_DELAY_NS:
            self._setup = following
        return True

    def _lost(self, message: ComputedMessage) -> list[StateMessage]:
        """States of the steps whose outputs are not in the recording, if it is certain which they are."""
        previous = self._previous
        if previous is None or not message.step:
            return []
        passed_over = set(message.skipped)
        if message.tick - previous.tick > 1 + len(passed_over) + len(self._tape.states):
            return []  # not all of them were recorded, however far the tick claims to be
        ticks = [tick for tick in range(previous.tick + 1, message.tick) if float(tick) not in passed_over]
        found = [self._tape.states.get((message.epoch, tick)) for tick in ticks]
        known = [state for state in found if state is not None]
        return known if len(known) == len(ticks) == message.step - previous.step - 1 else []

    def _gap(self, message: ComputedMessage, made_up: int) -> str:
        previous = self._previous
        missing = message.step - previous.step - 1 - made_up if previous is not None and message.step else 0
        return f"{_outputs(missing)} before it not recorded" if missing > 0 else ""

    def _step(self, state: StateMessage, message: ComputedMessage | None, unknown: str) -> ReplayedStep:
        node, robot = self._node, self._tape.robot
        assert node is not None
        for tick in () if message is None else message.skipped:
            passed_over = self._tape.states.get((state.epoch, int(tick)))
            if passed_over is not None:
                node.prepare(robot, self._overrule.state(passed_over))
        if self._changes is not None and message is not None:
            unknown = unknown or self._changes.follow(node, robot, state, _model(message))
        inputs, missing = self._inputs(node, state, message)
        if isinstance(node, SafetyFilterNode) and isinstance(message, VerdictMessage):
            node.orders.end(message.ordered)  # by whom and for whom it was does not matter to the decision
        if isinstance(node, PerceptionNode):
            missing = missing or self._sense(node, state, message)
        outputs = self._computed(node, state, inputs)
        self._overrule.done(state, outputs)
        if message is None:
            self._made_up |= {(topic, state.epoch, state.tick): item for topic, item in outputs.items()}
        return ReplayedStep(state, message, outputs, unknown or missing)

    def _sense(self, node: PerceptionNode, state: StateMessage, message: ComputedMessage | None) -> str:
        """Lets perception hear the scans that it had heard, with what counted then; what is missing of that."""
        if not isinstance(message, SurroundingsMessage):
            return "which scans it had heard is not recorded"
        node.switches.replay(self._tape.robot, message.off, message.zones, message.ordered)
        missing = ""
        for index, number in message.scans:
            source = state.sources[int(index)] if 0 <= index < len(state.sources) else ""
            scan = self._tape.scan((state.epoch, source, int(number)))
            if scan is None:
                missing = f"scan {number:g} of {source or 'a source that the state does not name'} was not recorded"
                continue
            with contextlib.suppress(InputError):  # as in the loop: what is no scan is refused
                node.hear(self._tape.robot, scan)
        return missing

    def _computed(self, node: AbstractNode, state: StateMessage, inputs: Inputs) -> dict[Topic, Message]:
        """Step and what comes after it; where they fail, as the service's loop does it."""
        robot, shown = self._tape.robot, self._overrule.state(state)
        outputs: dict[Topic, Message] = {}
        try:
            outputs.update(node.step(robot, shown, inputs))
        except Exception as error:  # noqa: BLE001  as in the loop: whatever it is, the node says what is right then
            reason = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
            return dict(node.rescue(robot, shown, reason))
        if self._changes is not None:
            self._changes.answer(node, robot, shown)
        with contextlib.suppress(Exception):  # as in the loop: the action is on its way
            outputs.update(node.afterwards(robot))
        return outputs

    def _inputs(self, node: AbstractNode, state: StateMessage, message: ComputedMessage | None) -> tuple[Inputs, str]:
        """The inputs of a step, and what is not known of them."""
        found: dict[Topic, Message | Stale] = {}
        missing = ""
        for index, topic in enumerate(node.needs(state)):
            reported = message.consumed[index] if message is not None and index < len(message.consumed) else None
            item = self._of_tick(topic, state) if reported is None else self._reported(topic, state, *reported)
            if item is None:
                item = self._made_up.get((topic, state.epoch, state.tick))
            if item is None:
                missing = f"the {topic.name} that it used was not recorded"
                item = self._of_tick(topic, state)
            found[topic] = item if isinstance(item, Stale) else self._overrule.message(item)
        return found, missing

    def _reported(self, topic: Topic, state: StateMessage, age: float, published: float) -> Message | Stale | None:
        """The input that a step says it used; None when it is not in the recording."""
        if published == 0.0:
            return Stale(topic, None if age < 0 else int(age))
        return self._tape.named.get((topic, state.epoch, state.tick - int(age), published))

    def _of_tick(self, topic: Topic, state: StateMessage) -> Message | Stale:
        """What a step will have used that does not say it: the input of its tick, if that was recorded."""
        for tick in range(state.tick, max(state.tick - _LOOK_BACK_TICKS, -1), -1):
            item = self._tape.newest.get((topic, state.epoch, tick)) or self._made_up.get((topic, state.epoch, tick))
            if item is not None:
                return item if tick == state.tick else Stale(topic, state.tick - tick)
        return Stale(topic, None)


def _model(message: ComputedMessage) -> str:
    """Fingerprint of the model with which a message was computed; empty where an older program did not tell."""
    return str(getattr(message, "model", ""))


def _outputs(count: int) -> str:
    return "some outputs" if count < 1 else f"{count} output{'s' if count > 1 else ''}"


class ModelChange:
    """Takes one node through the changes of the model to which its service answered.

    An offer is heard in the tick in which the service said that it is ready (or refuses), a take before the first
    output that was computed with the new model. ``document`` of a model that is nowhere in the recording is missing;
    ``follow`` then says so.
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
        """Number of the change for which the node is ready; 0: none."""

    def begin(self, node: AbstractNode, robot: str, wanted: str) -> str:
        """Lets a new node begin with the model that was in force; returns what is missing, empty when nothing is."""
        self._prepared = 0
        if wanted and node.model_of(robot) != wanted:
            node.welcome(robot, self._status(wanted))
        return self._missing(node, robot, wanted)

    def follow(self, node: AbstractNode, robot: str, state: StateMessage, wanted: str) -> str:
        """Before a step: takes the model with which it was computed; returns what is missing, empty when nothing is."""
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
        node.welcome(robot, _pending(status, state))
        return ""

    def answer(self, node: AbstractNode, robot: str, state: StateMessage) -> None:
        """Before what comes after a step: hears the offers that the service answered in that tick."""
        for change, outcome in self._answers.get((state.epoch, state.tick), ()):
            offer = self._offers.get(change)
            if offer is not None and outcome in ("ready", "refused"):
                node.hear(robot, offer)
                self._prepared = change if outcome == "ready" else self._prepared

    def _status(self, fingerprint: str) -> Answer | None:
        """What the diagnosis, or another service, will have said of the model in force."""
        offers = [offer for offer in self._offers.values() if offer.fingerprint == fingerprint]
        if not offers and fingerprint not in self._texts:
            return None
        number = offers[-1].change if offers else 0
        document, margin = (offers[-1].document, offers[-1].margin) if offers else self._texts[fingerprint]
        return Answer(
            ok=True, sentence="as recorded", change=number, fingerprint=fingerprint, document=document, margin=margin
        )

    def _take(self, offer: ModelMessage, state: StateMessage) -> ModelMessage:
        """The take as it was sent, or one that says the same."""
        sent = self._takes.get(offer.change)
        if sent is not None and (sent.epoch != state.epoch or sent.from_tick <= state.tick):
            return sent
        return ModelMessage(
            epoch=state.epoch,
            tick=state.tick,
            robot_time=state.robot_time,
            publish_time=time.time(),
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
        return f"model {wanted} was in force, and its file is not in the recording (the replay has {found})"


def _pending(status: Answer, state: StateMessage) -> Answer:
    """The same model as a change that is to be taken now."""
    return Answer(
        ok=True,
        sentence=status.sentence,
        change=status.change,
        pending="take",
        pending_fingerprint=status.fingerprint,
        pending_document=status.document,
        pending_margin=status.margin,
        fingerprint=" ",
        epoch=state.epoch,
        from_tick=state.tick,
    )
