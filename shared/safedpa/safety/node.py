"""The safety filter service's step: action[k] and its verdict from state[k], latent[k] and wish[k].

Whatever is missing, an action goes out in time: without a wish, or with a latent that is too old, it is the backup.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, TypedDict, final

import numpy as np
from numpy.typing import NDArray

from safedpa.bus import (
    ACTION,
    LATENT,
    VERDICT,
    WISH,
    AbstractNode,
    ActionMessage,
    Inputs,
    LatentMessage,
    Outputs,
    Stale,
    StateMessage,
    VerdictMessage,
    WishMessage,
)
from safedpa.dynamics import PhysicsModel, fingerprint
from safedpa.errors import InputError
from safedpa.safety.barrier import AbstractBarrier
from safedpa.safety.calibration import MarginCalibration
from safedpa.safety.safety_filter import SafetyFilter
from safedpa.safety.scene import SceneBarriers
from safedpa.safety.settings import FilterSettings
from safedpa.safety.verdict import Verdict
from safedpa.safety.watched_margin import WatchedMargin

__all__ = ["SafetyFilterNode"]

Values = NDArray[np.float64]

_LATENT_PATIENCE_TICKS = 20
"""How long the last latent stands in for a missing one: one second, in which a load does not change unnoticed."""
_PREDICTED_STEPS = 8


class _Stamp(TypedDict):
    epoch: int
    tick: int
    robot_time: float
    publish_time: float


@dataclass
class _Robot:
    """What is remembered of one robot between ticks."""

    filter: SafetyFilter
    scene: SceneBarriers
    margin: WatchedMargin
    tick: int = -1
    latent: LatentMessage | None = None
    state: Values | None = None
    memory: Any = field(default=None)


@final
class SafetyFilterNode(AbstractNode):
    """Filters the wishes for each robot. With ``settings.enabled`` false it hands wishes on and says so."""

    name = "safety_filter"
    inputs = (LATENT, WISH)
    outputs = (ACTION, VERDICT)
    share = 0.5

    def __init__(
        self,
        model: PhysicsModel,
        settings: FilterSettings | None = None,
        calibration: MarginCalibration | None = None,
    ) -> None:
        self._model = model
        self._settings = settings or FilterSettings()
        self._fingerprint = fingerprint(model)
        self._calibration = calibration or self._uncalibrated()
        if self._calibration.fingerprint != self._fingerprint:
            raise InputError(
                f"margin: calibrated for model {self._calibration.fingerprint}, the filter has {self._fingerprint}; "
                "calibrate it anew with 'safedpa calibrate'"
            )
        self._robots: dict[str, _Robot] = {}

    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:  # noqa: D102
        memory = self._robots.get(robot)
        if memory is None:
            memory = self._robots[robot] = _Robot(
                SafetyFilter.for_model(self._model, self._settings),
                SceneBarriers(self._settings),
                WatchedMargin(self._calibration),
            )
        wish = inputs[WISH]
        latent, stale = self._latent(memory, state, inputs)
        if isinstance(wish, Stale):
            stale.append(f"the wish ({wish.sentence})")
        self._remember_actuators(memory, state)
        barriers = memory.scene.of(state)
        self._watch_margin(memory, state, () if isinstance(barriers, str) else barriers)
        if isinstance(barriers, str):
            stale.append(f"the {barriers}")
        verdict = memory.filter.decide(
            state.values,
            wish.values if isinstance(wish, WishMessage) else None,
            latent,
            memory=memory.memory,
            barriers=() if isinstance(barriers, str) else barriers,
            epsilon=memory.margin.epsilon,
            stale=stale,
        )
        predicted = self._predicted(memory, state, verdict, latent)
        memory.margin.expect(np.array(predicted[0]) if predicted else None)
        return self._messages(state, verdict, predicted)

    def forget(self, robot: str) -> None:  # noqa: D102
        self._robots.pop(robot, None)

    def _uncalibrated(self) -> MarginCalibration:
        """The margins of the settings, which no data stand behind."""
        return MarginCalibration(dict(self._settings.epsilon), 0.99, 1, "never", self._fingerprint)

    def _watch_margin(self, memory: _Robot, state: StateMessage, barriers: Sequence[AbstractBarrier]) -> None:
        if state.tick != memory.tick + 1 or state.applied_by != "filter":
            memory.margin.expect(None)  # what was predicted is not what was done
        memory.tick = state.tick
        memory.margin.observe(np.array(state.values), barriers)

    def _latent(self, memory: _Robot, state: StateMessage, inputs: Inputs) -> tuple[Values | None, list[str]]:
        """The latent to use, and what is wrong with it."""
        message = inputs[LATENT]
        if isinstance(message, LatentMessage):
            if message.model != self._fingerprint:
                return None, [f"the latent (of model {message.model}, the filter has {self._fingerprint})"]
            memory.latent = message
        known = memory.latent
        if known is None or known.epoch != state.epoch or state.tick - known.tick > _LATENT_PATIENCE_TICKS:
            return None, ["the latent (none of the last second has arrived)"]
        return np.array(known.values), []

    def _remember_actuators(self, memory: _Robot, state: StateMessage) -> None:
        """Advances what the actuators remember by the action in force over the period that ended."""
        if len(state.applied) != len(self._model.system.action):
            return  # the filter refuses the state for its own reasons; nothing to learn here
        applied = np.array(state.applied)
        if memory.memory is None or memory.state is None:
            memory.memory = self._model.initial_memory(applied)
        else:
            memory.memory = self._model.advance(memory.state, applied, memory.memory, period=state.period)[1]
        if len(state.values) == len(self._model.system.state):
            memory.state = np.array(state.values)

    def _predicted(
        self, memory: _Robot, state: StateMessage, verdict: Verdict, latent: Values | None
    ) -> tuple[tuple[float, ...], ...]:
        """The next states (steps, states) that the model expects under the action held."""
        if len(state.values) != len(self._model.system.state):
            return ()
        current, actuators, rows = np.array(state.values), memory.memory, []
        for _ in range(_PREDICTED_STEPS):
            current, actuators = self._model.advance(current, verdict.action, actuators, latent, period=state.period)
            rows.append(tuple(float(value) for value in current))
        return tuple(rows) if np.isfinite(rows).all() else ()

    def _messages(self, state: StateMessage, verdict: Verdict, predicted: tuple[tuple[float, ...], ...]) -> Outputs:
        action = tuple(verdict.action.tolist())
        stamp = _Stamp(epoch=state.epoch, tick=state.tick, robot_time=state.robot_time, publish_time=time.time())
        report = VerdictMessage(
            **stamp,
            status=verdict.status.value,
            sentence=verdict.sentence,
            action=action,
            wish=() if verdict.wish is None else tuple(verdict.wish.tolist()),
            slack=verdict.slack,
            active=verdict.active,
            h_now=verdict.h_now,
            h_next=verdict.h_next,
            margin=verdict.margin,
            solver=verdict.solver,
            microseconds=verdict.microseconds,
            predicted=predicted,
        )
        return {ACTION: ActionMessage(**stamp, values=action), VERDICT: report}
