"""Many pendulums in the closed loop at a time: adaptation, nominal action, filter, motor, one after the other in every
period."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import final

import numpy as np

from safedpa.adaptation.batch_history_estimator import BatchHistoryEstimator
from safedpa.arrays import FloatArray
from safedpa.dynamics import LearnedBase, PhysicsModel, Setting
from safedpa.safety import FilterSettings
from safedpa.safety.batch.barriers import CompiledBatchBarriers
from safedpa.safety.batch.filter import STATUSES, BatchFilter
from safedpa.safety.verdict import Status
from safedpa_sim.pendulum.task import TORQUE, corridor, simulated_pendulum

NominalPolicy = Callable[[FloatArray, FloatArray], FloatArray]
"""Torques (n, 1) [N m] for states (n, 2) and latents (n, latents)."""
_FAILED = tuple(STATUSES.index(status) for status in (Status.relaxed, Status.violated, Status.fallback))
_PASSED = STATUSES.index(Status.passed)


@final
@dataclass(frozen=True)
class Closed:
    """What stands between a nominal action and the motor."""

    settings: FilterSettings | None = None
    """None: nothing, the nominal action is clipped to the torque's bounds."""
    model: PhysicsModel | None = None
    """Of the filter."""
    adapts: PhysicsModel | None = None
    """Whose history encoder reports the latent, to the policy and to the filter where its model has one."""
    reported: bool = False
    """The filter's latent is the true wind: an oracle."""
    torque: float = TORQUE
    """N m; what the motor gives at most, whatever is asked of it."""


@final
@dataclass(frozen=True)
class Swung:
    """What happened, for n pendulums over ``ticks`` periods."""

    states: FloatArray
    """(ticks + 1, n, 2)."""
    seen: FloatArray
    """(ticks + 1, n, 2) as the sensors tell them."""
    torques: FloatArray
    """(ticks, n)."""
    latents: FloatArray
    """(ticks, n, latents)."""
    corrected: FloatArray
    """(n,) share of the ticks in which the filter changed the nominal action."""
    relaxed: FloatArray
    """(n,) share in which no torque kept the corridor by its model, or none was known."""


def physics_in_any_wind() -> PhysicsModel:
    """The simulated pendulum with the wind as its latent."""
    model = simulated_pendulum()
    free = {path: Setting(0.0, free=True) for path in ("wind.speed", "wind.upward")}
    return model.with_settings({**model.settings, **free})


def blown(state: FloatArray, torque: FloatArray, wind: FloatArray) -> FloatArray:
    """States (n, 2) one period later under torques (n, 1) in winds (n, 2)."""
    model = physics_in_any_wind()
    return np.asarray(model.advance(state, torque, model.initial_memory(torque, wind), wind)[0])


def swung(
    closed: Closed,
    nominal: NominalPolicy,
    start: FloatArray,
    wind: FloatArray,
    edges: tuple[float, float],
    ticks: int,
    sensed: Callable[[FloatArray], FloatArray] = np.array,
) -> Swung:
    """Swings n pendulums from ``start`` (n, 2) in constant winds (n, 2) [m/s].

    ``sensed`` makes of true states (n, 2) what adaptation, policy and filter see of them.
    """
    count, state = len(start), np.array(start, dtype=np.float64)
    world = physics_in_any_wind()
    seen = sensed(state)
    history, latent = _histories(closed.adapts, count)
    if history is not None:
        history.see(seen)
    filters, barriers = _filter(closed), CompiledBatchBarriers.of([[corridor(edges)]] * count, state.shape[1])
    states, looks, torques, latents = [state], [seen], [], []
    changed, failed = np.zeros(count), np.zeros(count)
    for _ in range(ticks):
        nominal_values = nominal(seen, latent)
        torque = np.clip(nominal_values, -closed.torque, closed.torque)
        if filters is not None:
            verdicts = filters.decide(seen, nominal_values, _known(closed, latent, wind), barriers=barriers)
            torque = verdicts.action
            changed += verdicts.status != _PASSED
            failed += np.isin(verdicts.status, _FAILED)
        following = np.asarray(world.advance(state, torque, world.initial_memory(torque, wind), wind)[0])
        latents.append(latent)
        state, seen = following, sensed(following)
        if history is not None:
            history.acted(torque)
            latent = history.see(seen)
        states.append(state)
        looks.append(seen)
        torques.append(torque[:, 0].copy())
    every = [np.stack(rows) for rows in (states, looks, torques, latents)]
    return Swung(every[0], every[1], every[2], every[3], changed / ticks, failed / ticks)


def _filter(closed: Closed) -> BatchFilter | None:
    """The filter of the bus, for many at once."""
    if closed.settings is None or closed.model is None:
        return None
    return BatchFilter(closed.model, closed.settings)


def _known(closed: Closed, latent: FloatArray, wind: FloatArray) -> FloatArray | None:
    """What the filter's model is given."""
    if closed.reported:
        return wind
    return latent if closed.model is not None and closed.model.latent_names else None


def _histories(model: PhysicsModel | None, count: int) -> tuple[BatchHistoryEstimator | None, FloatArray]:
    """Those of the model's history encoder, if it has one, and the latents (n, latents) of its file to begin with."""
    if model is None or not isinstance(model.base, LearnedBase) or not model.base.weights.has("phi"):
        return None, np.zeros((count, 0))
    return BatchHistoryEstimator(model.base.weights, count), np.tile(model.latent, (count, 1))


def believed_wind(model: PhysicsModel, latents: FloatArray, strength: float, directions: int = 360) -> FloatArray:
    """Direction [rad] (...,) of the wind of ``strength`` whose mu(e) is nearest to each latent (..., latents)."""
    base = model.base
    assert isinstance(base, LearnedBase)
    angles = 2 * np.pi * np.arange(directions) / directions
    circle = base.networks.encode(strength * np.stack((np.cos(angles), np.sin(angles)), axis=1))
    distance = np.square(latents[..., np.newaxis, :] - circle).sum(-1)
    return np.asarray(angles[distance.argmin(-1)])
