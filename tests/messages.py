"""Messages of a control loop with default fields."""

from typing import Any

from safedpa.bus import FindingMessage, HealthMessage, LatentMessage, StateMessage, VerdictMessage

STAMP: dict[str, Any] = {"epoch": 1, "tick": 0, "robot_time": 0.0, "publish_time": 0.0}


def stamp(tick: int, period: float = 0.05, epoch: int = 1) -> dict[str, Any]:
    """Returns the header of a message of a tick, on a clock that was 0 at tick 0."""
    return {"epoch": epoch, "tick": tick, "robot_time": period * tick, "publish_time": 0.0}


def state_of(*values: float, **fields: Any) -> StateMessage:
    """Returns a state; without ``values`` that of a car."""
    usual = STAMP | {"applied": (0.0, 0.0), "applied_by": "filter", "period": 0.05, "lockstep": False}
    usual |= {"goal": (1.0, 1.0), "obstacles": (), "field": (-4.0, 4.0, -4.0, 4.0), "footprint": (0.1, 0.3, 0.2)}
    return StateMessage(**{**usual, "values": values or (0.0, 0.0, 0.0, 1.0), **fields})


def latent_of(*values: float, **fields: Any) -> LatentMessage:
    """Returns a latent of model m with a standard deviation of 0.1."""
    return LatentMessage(**{**STAMP, "model": "m", "values": values, "deviations": (0.1,) * len(values), **fields})


def verdict_of(status: str, **fields: Any) -> VerdictMessage:
    """Returns a verdict with default fields."""
    usual = STAMP | {"sentence": "", "action": (0.0, 0.0), "nominal": (), "slack": 0.0, "active": (), "h_now": 1.0}
    usual |= {"h_next": 1.0, "margin": 0.0, "solver": "", "microseconds": 1.0}
    return VerdictMessage(**{**usual, "status": status, **fields})


def health_of(service: str, **fields: Any) -> HealthMessage:
    """Returns a heartbeat of a service in process 4711."""
    usual = STAMP | {"pid": 4711, "state": "running", "detail": "", "steps": 1, "stale": 0, "refused": 0}
    return HealthMessage(**{**usual, "service": service, **fields})


def finding_of(stage: str, **fields: Any) -> FindingMessage:
    """Returns a finding about a car with an error of its yaw."""
    usual = STAMP | {"model": "aaaaaaaa", "sentence": f"it is {stage}", "number": 1, "error": 0.3, "band": 0.06}
    usual |= {"evidence": 1.0, "threshold": 13.8, "coverage": 1.0, "where": "yaw"}
    return FindingMessage(**{**usual, "stage": stage, **fields})
