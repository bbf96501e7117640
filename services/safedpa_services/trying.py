"""What is done with an offered model in a process of its own: the service's own node takes it, and drives with it.

The node is made again from the options of the service, told what is in force, and offered the model at the robot's
newest state, as in the service. Where it is ready, it goes on for some ticks with the new model, which must not take
more of the processor than a tick has to give.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from safedpa.bus import (
    LATENT,
    NOMINAL,
    TAKEOVER,
    AbstractNode,
    Answer,
    Inputs,
    LatentMessage,
    ModelMessage,
    NominalMessage,
    StateMessage,
    TakeoverMessage,
)
from safedpa.dynamics import PhysicsModel, load_model, parse_model, write_model
from safedpa.dynamics.learned_base import LearnedBase
from safedpa.errors import InputError
from safedpa.limits import check_plain_model
from safedpa_services.nodes import PreparedService, adaptation, policy, safety_filter

__all__ = ["LARGEST_SHARE", "tried"]

LARGEST_SHARE = 0.25
"""Of the robot's period: so much processor time a step of one service may take with an offered model."""
_TICKS = 12
_MADE: Mapping[str, Callable[[argparse.Namespace], PreparedService]] = {
    "adaptation": adaptation,
    "policy": policy,
    "safety_filter": safety_filter,
}


def tried(
    work: tuple[str, argparse.Namespace, str, ModelMessage, StateMessage, Answer | None],
) -> dict[str, Any]:
    """``{"document": ...}``, the model as this program writes it, or raises with the reason why it is refused."""
    name, options, robot, offer, state, agreed = work
    check_plain_model(offer.document)
    current = load_model(options.model)
    folder = None
    if isinstance(current.base, LearnedBase) and current.base.weights.source is not None:
        folder = current.base.weights.source.parent
    if agreed is not None and agreed.document:
        current = parse_model(agreed.document, folder)
    offered = parse_model(offer.document, folder)
    quiet = argparse.Namespace(**{**vars(options), "orders": ""})
    node = _MADE[name](quiet).node
    if agreed is not None:
        node.welcome(robot, agreed)
    _take(node, robot, offer, state, (current, offered))
    return {"document": write_model(offered)}


def _take(
    node: AbstractNode,
    robot: str,
    offer: ModelMessage,
    state: StateMessage,
    models: tuple[PhysicsModel, PhysicsModel],
) -> None:
    """The three steps of a change. Raises InputError where the node refuses, or is slow afterwards."""
    current, offered = models
    _tick(node, robot, state, current, node.model_of(robot))
    node.hear(robot, offer)
    answer = _tick(node, robot, _later(state, 1), current, node.model_of(robot))
    if answer is None or answer.state == "refused":
        raise InputError("it gave no answer" if answer is None else answer.reason)
    node.hear(robot, replace(offer, step="take", document="", margin="", epoch=state.epoch, from_tick=state.tick + 2))
    seconds = []
    for number in range(2, _TICKS):
        began = time.process_time()
        _tick(node, robot, _later(state, number), offered, offer.fingerprint)
        seconds.append(time.process_time() - began)
    usual, most = statistics.median(seconds), LARGEST_SHARE * state.period
    if usual > most:
        raise InputError(
            f"a tick with it takes {1e3 * usual:.1f} ms of the processor, wanted at most {1e3 * most:.1f} ms, "
            f"{LARGEST_SHARE:.0%} of the robot's period"
        )


def _tick(
    node: AbstractNode, robot: str, state: StateMessage, model: PhysicsModel, fingerprint: str
) -> TakeoverMessage | None:
    stamp: dict[str, Any] = {
        "epoch": state.epoch,
        "tick": state.tick,
        "robot_time": state.robot_time,
        "publish_time": 0.0,
    }
    latent = tuple(model.latent.tolist())
    resting = (0.0,) * len(model.system.action)
    inputs: Inputs = {
        LATENT: LatentMessage(**stamp, model=fingerprint, values=latent, deviations=latent),
        NOMINAL: NominalMessage(**stamp, values=resting, controller="trial"),
    }
    node.prepare(robot, state)
    outputs = dict(node.step(robot, state, {topic: inputs[topic] for topic in node.inputs}))
    outputs.update(node.afterwards(robot))
    answer = outputs.get(TAKEOVER)
    return answer if isinstance(answer, TakeoverMessage) else None


def _later(state: StateMessage, ticks: int) -> StateMessage:
    return replace(state, tick=state.tick + ticks, robot_time=state.robot_time + ticks * state.period)
