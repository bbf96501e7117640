"""The safety filter service's step: action[k] and its verdict from state[k], latent[k] and wish[k].

Whatever is missing, an action goes out in time: without a wish, or with a latent that is too old, it is the backup.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypedDict, final

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


class _Decided(NamedTuple):
    """The last decision."""

    state: StateMessage
    latent: Values | None
    verdict: Verdict


@dataclass
class _Robot:
    """What is remembered of one robot between ticks."""

    filter: SafetyFilter
    scene: SceneBarriers
    margin: WatchedMargin
    tick: int = -1
    prepared: tuple[int, int] = (0, -1)
    """Epoch and tick of the state that the fields below belong to."""
    barriers: tuple[AbstractBarrier, ...] | str = ()
    """Of the scene now, or what is wrong with it."""
    latent: LatentMessage | None = None
    decision: _Decided | None = None
    memory: Any = None
    """What the actuators remember, as the model has it."""
    expected_memory: Any = None
    """The same one period later, if the robot does what it is told."""


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
        self._calibration = (calibration or self._uncalibrated()).chosen(self._settings.margin)
        if self._calibration.fingerprint != self._fingerprint:
            raise InputError(
                f"margin: calibrated for model {self._calibration.fingerprint}, the filter has {self._fingerprint}; "
                "calibrate it anew with 'safedpa calibrate'"
            )
        self._robots: dict[str, _Robot] = {}

    def prepare(self, robot: str, state: StateMessage) -> None:  # noqa: D102
        memory = self._robots.get(robot)
        if memory is None:
            memory = self._robots[robot] = _Robot(
                SafetyFilter.for_model(self._model, self._settings),
                SceneBarriers(self._settings),
                WatchedMargin(self._calibration),
            )
        self._remember_actuators(memory, state)
        memory.barriers = memory.scene.of(state)
        self._watch_margin(memory, state, () if isinstance(memory.barriers, str) else memory.barriers)
        memory.prepared = (state.epoch, state.tick)

    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:  # noqa: D102
        memory = self._robots.get(robot)
        if memory is None or memory.prepared != (state.epoch, state.tick):
            self.prepare(robot, state)
            memory = self._robots[robot]
        wish = inputs[WISH]
        latent, stale = self._latent(memory, state, inputs)
        if isinstance(wish, Stale):
            stale.append(f"the wish ({wish.sentence})")
        if isinstance(memory.barriers, str):
            stale.append(f"the {memory.barriers}")
        verdict = memory.filter.decide(
            state.values,
            wish.values if isinstance(wish, WishMessage) else None,
            latent,
            memory=memory.memory,
            barriers=() if isinstance(memory.barriers, str) else memory.barriers,
            epsilon=memory.margin.epsilon,
            stale=stale,
        )
        memory.decision = _Decided(state, latent, verdict)
        return {ACTION: ActionMessage(**_stamp(state), values=tuple(verdict.action.tolist()))}

    def afterwards(self, robot: str) -> Outputs:
        """The verdict, with the next states that the model expects; the action is on its way already."""
        memory = self._robots[robot]
        assert memory.decision is not None
        state, latent, verdict = memory.decision
        predicted, memory.expected_memory = self._predicted(memory.memory, state, verdict, latent)
        memory.margin.expect(np.array(predicted[0]) if predicted else None)
        return {VERDICT: _report(state, verdict, predicted)}

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
        """What the actuators remember now: as expected if the robot did what it was told, else as if at rest there."""
        if len(state.applied) != len(self._model.system.action):
            return  # the filter refuses such a state for its own reasons; nothing to learn here
        told = memory.decision
        obeyed = told is not None and state.tick == told.state.tick + 1 and state.applied_by == "filter"
        if obeyed and memory.expected_memory is not None:
            memory.memory = memory.expected_memory
        else:
            memory.memory = self._model.initial_memory(np.array(state.applied))

    def _predicted(
        self, actuators: Any, state: StateMessage, verdict: Verdict, latent: Values | None
    ) -> tuple[tuple[tuple[float, ...], ...], Any]:
        """The next states (steps, states) that the model expects under the action held; actuators' memory after one."""
        if len(state.values) != len(self._model.system.state):
            return (), None
        current, rows, after_one = np.array(state.values), [], None
        for _ in range(_PREDICTED_STEPS):
            current, actuators = self._model.advance(current, verdict.action, actuators, latent, period=state.period)
            after_one = actuators if after_one is None else after_one
            rows.append(tuple(current.tolist()))
        return (tuple(rows), after_one) if np.isfinite(rows).all() else ((), None)


def _stamp(state: StateMessage) -> _Stamp:
    return _Stamp(epoch=state.epoch, tick=state.tick, robot_time=state.robot_time, publish_time=time.time())


def _report(state: StateMessage, verdict: Verdict, predicted: tuple[tuple[float, ...], ...]) -> VerdictMessage:
    return VerdictMessage(
        **_stamp(state),
        status=verdict.status.value,
        sentence=verdict.sentence,
        action=tuple(verdict.action.tolist()),
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
