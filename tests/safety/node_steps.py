"""One robot's messages to the filter's service, tick by tick, and its answers."""

from functools import partial
from typing import Any

from safedpa.bus import (
    LATENT,
    NOMINAL,
    SURROUNDINGS,
    VERDICT,
    LatentMessage,
    NominalMessage,
    Stale,
    StateMessage,
    SurroundingsMessage,
    VerdictMessage,
)
from safedpa.dynamics import PhysicsModel, Setting, fingerprint, load_model
from safedpa.effects import effect
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety.defaults import settings_named

CAR, SETTINGS = load_model("car"), settings_named("car")
LATE = CAR.with_effect(effect("car", "actuator_delay"), {"seconds": Setting(0.2)})
ABSENT = Stale(LATENT, None)
scripted_node = partial(SafetyFilterNode, limits=None)
"""The filter's node, believing any state: the states of a script do not follow from one another."""


def state_at(tick: int, values: tuple[float, ...] = (0.0, 0.0, 0.0, 0.5), **changed: Any) -> StateMessage:
    reported: dict[str, Any] = {
        "epoch": 1, "tick": tick, "robot_time": 0.05 * tick, "publish_time": 0.0, "values": values,
        "applied": (0.0, 0.0), "applied_by": "filter" if tick else "none", "period": 0.05, "lockstep": True,
        "goal": (5.0, 0.0), "obstacles": ((6.0, 0.0, 0.3),), "field": (-20.0, 20.0, -20.0, 20.0),
        "footprint": (0.08, 0.40, 0.12),
    }  # fmt: skip
    return StateMessage(**{**reported, **changed})


def stamp(state: StateMessage) -> dict[str, Any]:
    return {"epoch": state.epoch, "tick": state.tick, "robot_time": state.robot_time, "publish_time": 0.0}


def latent_at(state: StateMessage, model: PhysicsModel = CAR) -> LatentMessage:
    values = tuple(model.latent.tolist())
    return LatentMessage(**stamp(state), model=fingerprint(model), values=values, deviations=values)


def surroundings(state: StateMessage, **known: Any) -> SurroundingsMessage:
    """What perception says: nothing is near, but what is ``known``."""
    return SurroundingsMessage(**stamp(state), **{"points": (), "movers": (), "hidden": (), "ages": (0.05,), **known})


def answer_to(node: SafetyFilterNode, state: StateMessage, inputs: dict[Any, Any]) -> VerdictMessage:
    node.step("r", state, inputs)
    verdict = node.afterwards("r")[VERDICT]
    assert isinstance(verdict, VerdictMessage)
    return verdict


def asked(
    node: SafetyFilterNode,
    state: StateMessage,
    latent: LatentMessage | Stale,
    nominal: tuple[float, ...] = (1.0, 0.0),
    seen: SurroundingsMessage | Stale | None = None,
) -> VerdictMessage:
    inputs = {LATENT: latent, NOMINAL: NominalMessage(**stamp(state), values=nominal, controller="test")}
    return answer_to(node, state, inputs if seen is None else {**inputs, SURROUNDINGS: seen})
