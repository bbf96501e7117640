"""Many pendulums in the closed loop at a time: adaptation, wish, filter, motor, one after the other in every period."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from safedpa.dynamics import LearnedBase, PhysicsModel, Setting
from safedpa.networks import HistoryEncoder
from safedpa.safety import FilterSettings, SafetyFilter
from safedpa_sim.pendulum.task import corridor, simulated_pendulum

__all__ = ["Closed", "Swung", "believed_wind", "blown", "physics_in_any_wind", "swung"]

Floats = NDArray[np.float64]
Wish = Callable[[Floats, Floats], Floats]
"""Torques (n, 1) [N m] for states (n, 2) and latents (n, latents)."""


@final
@dataclass(frozen=True)
class Closed:
    """What stands between a wish and the motor."""

    settings: FilterSettings | None = None
    """None: nothing, the wish is clipped to the torque's bounds."""
    model: PhysicsModel | None = None
    """Of the filter."""
    adapts: PhysicsModel | None = None
    """Whose history encoder tells the latent, to the policy and to the filter where its model has one."""
    told: bool = False
    """The filter's latent is the true wind: an oracle."""


@final
@dataclass(frozen=True)
class Swung:
    """What happened, for n pendulums over ``ticks`` periods."""

    states: Floats
    """(ticks + 1, n, 2)."""
    torques: Floats
    """(ticks, n)."""
    latents: Floats
    """(ticks, n, latents)."""
    corrected: Floats
    """(n,) share of the ticks in which the filter changed the wish."""
    relaxed: Floats
    """(n,) share in which no torque kept the corridor by its model, or none was known."""


def physics_in_any_wind() -> PhysicsModel:
    """The simulated pendulum with the wind as its latent."""
    model = simulated_pendulum()
    free = {path: Setting(0.0, free=True) for path in ("wind.speed", "wind.upward")}
    return model.with_settings({**model.settings, **free})


def blown(state: Floats, torque: Floats, wind: Floats) -> Floats:
    """States (n, 2) one period later under torques (n, 1) in winds (n, 2)."""
    model = physics_in_any_wind()
    return np.asarray(model.advance(state, torque, model.initial_memory(torque, wind), wind)[0])


def swung(closed: Closed, wish: Wish, start: Floats, wind: Floats, edges: tuple[float, float], ticks: int) -> Swung:
    """Swings n pendulums from ``start`` (n, 2) in constant winds (n, 2) [m/s]."""
    count, state = len(start), np.array(start, dtype=np.float64)
    world = physics_in_any_wind()
    history = _History(closed.adapts, count)
    filters = _filters(closed, edges, count)
    states, torques, latents = [state], [], []
    changed, failed = np.zeros(count), np.zeros(count)
    for _ in range(ticks):
        latent = history.latent
        wished = wish(state, latent)
        known = wind if closed.told else latent if closed.model is not None and closed.model.latent_names else None
        torque = np.clip(wished, world.system.action_low, world.system.action_high)
        for index, item in enumerate(filters):
            verdict = item.decide(state[index], wished[index], None if known is None else known[index])
            torque[index] = verdict.action
            changed[index] += verdict.status.value != "passed"
            failed[index] += verdict.status.value in ("relaxed", "violated", "fallback")
        following = np.asarray(world.advance(state, torque, world.initial_memory(torque, wind), wind)[0])
        history.add(state, torque, following)
        state = following
        states.append(state)
        torques.append(torque[:, 0].copy())
        latents.append(latent.copy())
    return Swung(np.stack(states), np.stack(torques), np.stack(latents), changed / ticks, failed / ticks)


def _filters(closed: Closed, edges: tuple[float, float], count: int) -> list[SafetyFilter]:
    if closed.settings is None or closed.model is None:
        return []
    barrier = [corridor(edges)]
    return [SafetyFilter.for_model(closed.model, closed.settings, barrier) for _ in range(count)]


@final
class _History:
    """What ``HistoryEstimator`` does for one robot, for many."""

    def __init__(self, model: PhysicsModel | None, count: int) -> None:
        self._encoder = _encoder_of(model)
        if self._encoder is None or model is None:
            self.latent: Floats = np.zeros((count, 0))
            return
        self._rows = np.zeros((count, self._encoder.length, self._encoder.row_length))
        self.latent = np.tile(model.latent, (count, 1))

    def add(self, state: Floats, torque: Floats, following: Floats) -> None:
        if self._encoder is None:
            return
        self._rows[:, :-1] = self._rows[:, 1:]
        self._rows[:, -1] = self._encoder.rows(np.stack((state, following), axis=1), torque[:, np.newaxis])[:, 0]
        self.latent = self._encoder.encode(self._rows)


def _encoder_of(model: PhysicsModel | None) -> HistoryEncoder | None:
    if model is None or not isinstance(model.base, LearnedBase) or not model.base.weights.has("phi"):
        return None
    return HistoryEncoder(model.base.weights)


def believed_wind(model: PhysicsModel, latents: Floats, strength: float, directions: int = 360) -> Floats:
    """Direction [rad] (...,) of the wind of ``strength`` whose mu(e) is nearest to each latent (..., latents)."""
    base = model.base
    assert isinstance(base, LearnedBase)
    angles = 2 * np.pi * np.arange(directions) / directions
    circle = base.networks.encode(strength * np.stack((np.cos(angles), np.sin(angles)), axis=1))
    distance = np.square(latents[..., np.newaxis, :] - circle).sum(-1)
    return np.asarray(angles[distance.argmin(-1)])
