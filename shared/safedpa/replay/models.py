"""Which models a recording knows, and when each service answered for them."""

from __future__ import annotations

import time
from collections import defaultdict

from safedpa.bus import AbstractNode, Answer, ModelMessage, StateMessage
from safedpa.replay.tape import Stamp, Tape

__all__ = ["ModelChange"]


class ModelChange:
    """Takes one node through the changes of the model to which its service answered.

    An offer is heard in the tick in which the service said that it is ready (or refuses), a take before the first
    output that was computed with the new model. ``document`` of a model that is nowhere in the recording is missing;
    ``follow`` then says so.
    """

    def __init__(self, tape: Tape, service: str) -> None:
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
