"""Trial run of an offered model in a separate process, before the service itself takes the model.

The trial builds the service's node from the same options, gives it the model in force, and offers it the new model at
the robot's newest state. If the node accepts the model, it runs some ticks with it. The model is refused if a tick
takes too much CPU time.
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
from safedpa_services.service_factories import PreparedService, adaptation, policy, safety_filter

LARGEST_SHARE = 0.25
"""Largest CPU time of a service's step with an offered model, as a fraction of the robot's period."""
_TICKS = 12
_FACTORIES: Mapping[str, Callable[[argparse.Namespace], PreparedService]] = {
    "adaptation": adaptation,
    "policy": policy,
    "safety_filter": safety_filter,
}


def prepare() -> None:
    """Imports what a trial needs, before the first one: on a busy machine that takes most of its time."""
    import safedpa.adaptation
    import safedpa.policy
    import safedpa.runtime.node
    import safedpa.safety.defaults
    import safedpa.safety.margins.calibration  # noqa: F401


def run_model_trial(
    work: tuple[str, argparse.Namespace, str, ModelMessage, StateMessage, Answer | None],
) -> dict[str, Any]:
    """Returns ``{"document": ...}``: the model, written again by this program. Raises if the model is refused.

    :param work: name of the service, its options, the robot, the offer, the robot's newest state, and the answer that
        names the model in force (None: the model of the options)
    """
    name, options, robot, offer, state, agreed = work
    check_plain_model(offer.document)
    current = load_model(options.model)
    folder = None
    if isinstance(current.base, LearnedBase) and current.base.weights.source is not None:
        folder = current.base.weights.source.parent
    if agreed is not None and agreed.document:
        current = parse_model(agreed.document, folder)
    offered = parse_model(offer.document, folder)
    trial_options = argparse.Namespace(**{**vars(options), "orders": ""})  # the trial must not write the service's file
    node = _FACTORIES[name](trial_options).node
    if agreed is not None:
        node.adopt_model(robot, agreed)
    _take(node, robot, offer, state, (current, offered))
    return {"document": write_model(offered)}


def _take(
    node: AbstractNode,
    robot: str,
    offer: ModelMessage,
    state: StateMessage,
    models: tuple[PhysicsModel, PhysicsModel],
) -> None:
    """Offers the model, takes it and drives on. Raises InputError if the node refuses it or is too slow with it."""
    current, offered = models
    _tick(node, robot, state, current, node.model_of(robot))
    node.hear(robot, offer)
    answer = _tick(node, robot, _later(state, 1), current, node.model_of(robot))
    if answer is None or answer.state == "refused":
        raise InputError("the service gave no answer" if answer is None else answer.reason)
    node.hear(robot, replace(offer, step="take", document="", margin="", epoch=state.epoch, from_tick=state.tick + 2))
    seconds = []
    for number in range(2, _TICKS):
        began = time.process_time()
        _tick(node, robot, _later(state, number), offered, offer.fingerprint)
        seconds.append(time.process_time() - began)
    usual, most = statistics.median(seconds), LARGEST_SHARE * state.period
    if usual > most:
        raise InputError(
            f"a tick with it takes {1e3 * usual:.1f} ms of CPU time, wanted at most {1e3 * most:.1f} ms, "
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
