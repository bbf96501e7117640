"""What the filter's service remembers of one robot, after some ticks."""

from dataclasses import replace
from typing import Any

from tests.safety.node_steps import CAR, SETTINGS, latent_at, scripted_node, stamp, state_at

from safedpa.bus import LATENT, NOMINAL, NominalMessage
from safedpa.dynamics import PhysicsModel, fingerprint
from safedpa.runtime.robot_session import LastDecision, RobotSession
from safedpa.safety import Verdict


def driven(model: PhysicsModel = CAR, ticks: int = 1, action: tuple[float, float] = (1.0, 0.1)) -> RobotSession:
    """After so many ticks; from the second on the robot did what the filter decided."""
    node, applied = scripted_node(model, SETTINGS), (0.0, 0.0)
    for tick in range(ticks):
        state = state_at(tick, applied=applied)
        latent = replace(latent_at(state), model=fingerprint(model), values=tuple(model.latent.tolist()))
        nominal = NominalMessage(**stamp(state), values=action, controller="test")
        outputs = node.step("r", state, {LATENT: latent, NOMINAL: nominal})
        applied = next(iter(outputs.values())).values
        node.afterwards("r")
    return node._robots["r"]


def reported(memory: RobotSession) -> tuple[float, ...]:
    assert memory.decision is not None
    return tuple(memory.decision.verdict.action.tolist())


def verdict_of(memory: RobotSession, **changed: Any) -> Verdict:
    assert memory.decision is not None
    return replace(memory.decision.verdict, **changed)


def decided_of(memory: RobotSession, **changed: Any) -> LastDecision:
    assert memory.decision is not None
    return memory.decision._replace(verdict=verdict_of(memory, **changed))
