"""One robot's messages to the filter's service, tick by tick, and what it is answered."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from safedpa.bus import LATENT, VERDICT, WISH, LatentMessage, Stale, StateMessage, VerdictMessage, WishMessage
from safedpa.dynamics import PhysicsModel, Setting, fingerprint, load_model
from safedpa.effects import effect
from safedpa.safety import Verdict
from safedpa.safety.filtered_robot import FilteredRobot
from safedpa.safety.node import SafetyFilterNode
from safedpa.safety.shipped import settings_named

CAR, SETTINGS = load_model("car"), settings_named("car")
LATE = CAR.with_effect(effect("car", "actuator_delay"), {"seconds": Setting(0.2)})
ABSENT = Stale(LATENT, None)


def state_at(tick: int, values: tuple[float, ...] = (0.0, 0.0, 0.0, 0.5), **changed: Any) -> StateMessage:
    told: dict[str, Any] = {
        "epoch": 1, "tick": tick, "robot_time": 0.05 * tick, "publish_time": 0.0, "values": values,
        "applied": (0.0, 0.0), "applied_by": "filter" if tick else "none", "period": 0.05, "lockstep": True,
        "goal": (5.0, 0.0), "obstacles": ((6.0, 0.0, 0.3),), "field": (-20.0, 20.0, -20.0, 20.0),
        "footprint": (0.08, 0.40, 0.12),
    }  # fmt: skip
    return StateMessage(**{**told, **changed})


def stamp(state: StateMessage) -> dict[str, Any]:
    return {"epoch": state.epoch, "tick": state.tick, "robot_time": state.robot_time, "publish_time": 0.0}


def latent_at(state: StateMessage) -> LatentMessage:
    values = tuple(CAR.latent.tolist())
    return LatentMessage(**stamp(state), model=fingerprint(CAR), values=values, deviations=values)


def asked(
    node: SafetyFilterNode, state: StateMessage, latent: Any, wish: tuple[float, ...] = (1.0, 0.0)
) -> VerdictMessage:
    inputs = {LATENT: latent, WISH: WishMessage(**stamp(state), values=wish, controller="test")}
    node.step("r", state, inputs)
    verdict = node.afterwards("r")[VERDICT]
    assert isinstance(verdict, VerdictMessage)
    return verdict


def memory_of(node: SafetyFilterNode) -> FilteredRobot:
    return node._robots["r"]


def driven(model: PhysicsModel = CAR, ticks: int = 1, action: tuple[float, float] = (1.0, 0.1)) -> FilteredRobot:
    """After so many ticks, in which it did what it was told from the second on."""
    node = SafetyFilterNode(model, SETTINGS)
    applied = (0.0, 0.0)
    for tick in range(ticks):
        state = state_at(tick, applied=applied)
        latent = replace(latent_at(state), model=fingerprint(model), values=tuple(model.latent.tolist()))
        wish = WishMessage(**stamp(state), values=action, controller="test")
        outputs = node.step("r", state, {LATENT: latent, WISH: wish})
        applied = next(iter(outputs.values())).values  # type: ignore[union-attr,assignment]
        node.afterwards("r")
    return memory_of(node)


def told(memory: FilteredRobot) -> tuple[float, ...]:
    assert memory.decision is not None
    return tuple(memory.decision.verdict.action.tolist())


def verdict_of(memory: FilteredRobot, **changed: Any) -> Verdict:
    assert memory.decision is not None
    return replace(memory.decision.verdict, **changed)
