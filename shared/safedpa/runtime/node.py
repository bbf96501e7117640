"""The safety filter service's step: action[k] and its verdict from state[k], latent[k] and nominal action[k].

Whatever is missing, an action goes out in time: without a nominal action, or with a latent that is too old, it is the backup.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any, ClassVar, final

from safedpa.bus import (
    ACTION,
    LATENT,
    MODEL,
    NOMINAL,
    SURROUNDINGS,
    TAKEOVER,
    VERDICT,
    AbstractNode,
    ActionMessage,
    Answer,
    Inputs,
    LatentMessage,
    Message,
    ModelMessage,
    NominalMessage,
    Outputs,
    Stale,
    StateMessage,
    SurroundingsMessage,
    Topic,
    VerdictMessage,
)
from safedpa.bus.service.model_versions import ModelVersions
from safedpa.bus.service.sandbox import AbstractJobHandle
from safedpa.dynamics import PhysicsModel, fingerprint
from safedpa.runtime.calibrated_model import CalibratedModel, accept_offer, checked_calibration, uncalibrated
from safedpa.runtime.robot_session import NO_BARRIERS, LastDecision, RobotSession, state_too_old
from safedpa.runtime.stop_orders import StopOrders
from safedpa.safety.barriers.base import AbstractBarrierSet
from safedpa.safety.margins.calibration import MarginCalibration
from safedpa.safety.margins.transition import least_by_kind, margin_change
from safedpa.safety.settings import FilterSettings
from safedpa.safety.verdict import Status, Verdict, resting_verdict

__all__ = ["SafetyFilterNode"]

_IS_STATIONARY = 0.02
"""m/s; slower than that a car stands."""
_WIDTHS = 1e3
"""Margins that no one can keep, as multiples of the largest |h| and of the margins in force."""


@final
class SafetyFilterNode(AbstractNode):
    """Filters the requests each robot. With ``settings.enabled`` false it hands nominal actions on and says so.

    A new model comes with its own margin, and the watch over the margin begins again. A latent of another model than the
    filter's is none: the backup acts until both services have the same one. Raises InputError when the calibration
    belongs to another model, the settings are another robot's, or no one wrote barriers for this one.
    """

    name = "safety_filter"
    inputs = (LATENT, NOMINAL)
    outputs = (ACTION, VERDICT, TAKEOVER)
    listens = (MODEL,)
    sensor_inputs = (SURROUNDINGS,)
    share = 0.5
    # As the policy: a nominal action does not wait for news of a load. The watch over the margin sees what that costs.
    slack: ClassVar[Mapping[Topic, int]] = {LATENT: 1}

    def __init__(
        self,
        model: PhysicsModel,
        settings: FilterSettings | None = None,
        calibration: MarginCalibration | None = None,
        orders: StopOrders | None = None,
    ) -> None:
        self.orders = orders or StopOrders()
        """Who is to stop."""
        self._settings = settings or FilterSettings()
        known = calibration or uncalibrated(self._settings, fingerprint(model))
        first = CalibratedModel(
            model, fingerprint(model), checked_calibration(known, fingerprint(model), self._settings)
        )
        RobotSession.begun(first, self._settings)  # refuses another robot now, and not at its first tick
        self._versions = ModelVersions(self.name, first, first.fingerprint, self._load, self._predicted)
        self._robots: dict[str, RobotSession] = {}
        self._broken: dict[str, RobotSession] = {}
        """Of robots whose last step failed: their margin goes on."""
        self._rehearsed: PhysicsModel | None = None
        """With which a decision was rehearsed last; robots of one period share it."""

    def prepare(self, robot: str, state: StateMessage) -> None:  # noqa: D102
        if self._versions.begin(robot, state) and robot in self._robots:
            self._robots[robot].changed_at = state.tick
        memory = self._robots.get(robot)
        if memory is not None and memory.model.period != state.period:
            self._broken[robot], memory = memory, None
        if memory is None:
            broken = self._broken.pop(robot, None)
            before = None if broken is None else broken.margin.epsilon
            memory = RobotSession.begun(self._versions.of(robot), self._settings, before, state.period)
            if broken is not None and _same_margin(broken, memory):
                memory.margin = broken.margin
                memory.margin.expect(None)
            memory.inherit_from(broken)
            self._robots[robot] = memory
        memory.observe_state(state)

    def _with_latent(self, robot: str, state: StateMessage, inputs: Inputs) -> RobotSession:
        """The robot's memory with the model to decide with: a new one from the first latent of it on.

        The latent that a tick gets may be one tick old, and then it is of the old model: model, latent and margin of
        until now belong together, and decide again. For so long as a missing latent is waited for, and no longer.
        """
        memory, held = self._robots[robot], self._versions.of(robot)
        if memory.held is held:
            return memory
        latent = inputs[LATENT]
        of_before = not isinstance(latent, LatentMessage) or latent.model == memory.held.fingerprint
        if of_before and memory.held.fingerprint != held.fingerprint and memory.may_use_previous_model(state):
            return memory
        begun = RobotSession.begun(held, self._settings, memory.margin.epsilon, state.period)
        begun.inherit_from(memory)
        self._robots[robot] = begun
        self.prepare(robot, state)
        return self._robots[robot]

    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:  # noqa: D102
        memory = self._robots.get(robot)
        if memory is None or memory.prepared != (state.epoch, state.tick):
            self.prepare(robot, state)
        memory = self._with_latent(robot, state, inputs)
        if state.sources:
            seen = inputs[SURROUNDINGS]
            assert isinstance(seen, SurroundingsMessage | Stale)
            memory.see(state, seen)
        nominal = inputs[NOMINAL]
        latent, stale = memory.usable_latent(state, inputs)
        absent = f"the nominal action ({nominal.sentence})" if isinstance(nominal, Stale) else ""
        holds = bool(absent and not memory.scene.stationary_for)
        if absent and not holds:
            stale.append(absent)
        stale.extend(state_too_old(state))
        if isinstance(memory.barriers, str):
            stale.append(f"the {memory.barriers}")
        barriers = NO_BARRIERS if isinstance(memory.barriers, str) else memory.barriers
        known: dict[str, Any] = {
            "memory": memory.pending,
            "barriers": barriers,
            "epsilon": memory.margin.epsilon,
            "stale": stale,
            "time": state.robot_time,
        }
        ordered = memory.ordered = self.orders.reason(robot)
        if ordered:
            verdict = memory.filter.stop(
                ordered, state.values, latent, stationary_for=memory.scene.stationary_for, **known
            )
        elif state.sources and memory.scene.yields_to and not stale:
            verdict = memory.filter.stop(
                memory.scene.yields_to, state.values, latent, stationary_for=memory.scene.stationary_for, **known
            )
        elif holds:
            verdict = memory.filter.hold(f"{absent} is stale", state.values, latent, **known)
        else:
            nominal_values = nominal.values if isinstance(nominal, NominalMessage) else None
            verdict = memory.filter.decide(state.values, nominal_values, latent, **known, searched=memory.searched)
            verdict = memory.out_of_the_layer(state, verdict, latent)
            verdict = memory.out_of_dead_band(
                state,
                verdict,
                latent,
                lambda: memory.filter.decide(state.values, self._settings.resting_action, latent, **known),
            )
        memory.decision = LastDecision(state, latent, verdict)
        return {ACTION: _action(state, tuple(verdict.action.tolist()))}

    def afterwards(self, robot: str) -> Outputs:
        """The verdict, with the next states that the model expects; the action is on its way already."""
        memory = self._robots[robot]
        assert memory.decision is not None
        state, latent, verdict = memory.decision
        predicted = memory.predict_states(state, verdict, latent)
        memory.watch_standing(state, predicted)
        if not (memory.rehearsed or isinstance(memory.barriers, str) or verdict.status is Status.fallback):
            memory.rehearsed = True
            if memory.model is not self._rehearsed:
                self._rehearsed = memory.model
                _rehearse(memory, memory.decision, memory.barriers)
        outputs: dict[Any, Message] = {VERDICT: _report(state, verdict, predicted, memory)}
        answer = self._versions.answer(robot, state)
        return outputs if answer is None else {**outputs, TAKEOVER: answer}

    def hear(self, robot: str, message: Message) -> None:  # noqa: D102
        assert isinstance(message, ModelMessage)
        self._versions.hear(robot, message)

    def try_apart(self, hand_in: Callable[[str, ModelMessage], AbstractJobHandle]) -> None:  # noqa: D102
        self._versions.hand_in = hand_in

    def newest(self, robot: str) -> StateMessage | None:  # noqa: D102
        memory = self._robots.get(robot)
        return None if memory is None or memory.decision is None else memory.decision.state

    def welcome(self, robot: str, status: Answer | None) -> None:  # noqa: D102
        self._versions.welcome(robot, status)

    def agreed(self, robot: str) -> Answer | None:  # noqa: D102
        return self._versions.agreed(robot)

    def model_of(self, robot: str) -> str:  # noqa: D102
        return self._versions.fingerprint(robot)

    def wind_up(self) -> None:  # noqa: D102
        self.orders.end("the safety filter is about to end")

    def at_rest(self, robot: str) -> bool:
        """Whether the robot stands by an order; at once of one that has no speed to lose, and so cannot stand."""
        memory = self._robots.get(robot)
        if memory is None or memory.decision is None:
            return False
        state, _, verdict = memory.decision
        speeds = [state.values[index] for index in memory.speeds if index < len(state.values)]
        return verdict.status in (Status.stopped, Status.fallback) and all(
            abs(speed) <= _IS_STATIONARY for speed in speeds
        )

    def rescue(self, robot: str, state: StateMessage, reason: str) -> Outputs:
        """The backup of a robot that does not rest by itself, else the resting action, and a verdict that says so.

        What is remembered of the robot may be broken and begins again, but for the margin, which may have been widened.
        """
        broken = self._robots.pop(robot, None)
        if broken is not None:
            self._broken[robot] = broken
        known = self._broken.get(robot)
        action = self._settings.resting_action if known is None else known.last_resort(state)
        verdict = resting_verdict(action, reason)
        return {ACTION: _action(state, tuple(verdict.action.tolist())), VERDICT: _report(state, verdict, ())}

    def forget(self, robot: str) -> None:  # noqa: D102
        self._robots.pop(robot, None)
        self._broken.pop(robot, None)

    def leave(self, robot: str) -> None:  # noqa: D102
        self.forget(robot)
        self._versions.forget(robot)

    def _load(self, robot: str, offer: ModelMessage) -> CalibratedModel:
        """The offered model and margin, tried at the robot's last decision. Raises InputError when it is not usable."""
        held = accept_offer(offer, self._versions.of(robot), self._settings)
        trial, memory = RobotSession.begun(held, self._settings), self._robots.get(robot)
        if memory is not None and memory.decision is not None:
            trial.sync_actuators(memory.decision.state)
            trial.try_out(memory.decision, memory.barriers)
        return held

    def _predicted(self, robot: str, held: CalibratedModel) -> str:
        """What the margin of an offered model would do where the robot is now."""
        memory, current = self._robots.get(robot), self._versions.of(robot).calibration.epsilon
        if memory is None or memory.decision is None or isinstance(memory.barriers, str):
            return margin_change(current, held.calibration.epsilon, {}, self._settings.eta)
        h = least_by_kind(memory.barriers, memory.decision.state.values)
        coming, _ = held.margin_over(memory.model.period, self._settings)
        return margin_change(memory.margin.epsilon, coming.epsilon, h, self._settings.eta)


def _same_margin(before: RobotSession, now: RobotSession) -> bool:
    """Whether what was watched goes on: of the same model, and of steps no shorter that were calibrated alike."""
    alike = before.held is now.held and before.margin.longer == now.margin.longer
    return alike and before.model.period >= now.model.period


def _action(state: StateMessage, values: tuple[float, ...]) -> ActionMessage:
    return ActionMessage(
        epoch=state.epoch, tick=state.tick, robot_time=state.robot_time, publish_time=time.time(), values=values
    )


def _rehearse(memory: RobotSession, decided: LastDecision, barriers: AbstractBarrierSet) -> None:
    """Goes once through all that a decision may need, before a robot drives; changes no verdict.

    The first decision for which no action satisfies every condition took 5 ms where the next take half of one: solvers make
    their workspaces, equations are written down, modules are imported. A tick of 5 ms has no time for it later. So it
    is decided with margins that nothing can keep, and the verdict is thrown away.
    """
    state = decided.state
    with suppress(Exception):  # whatever a user's equations raise, the robot drives as it would have without this
        memory.model.write_straight()
        widest = max([1.0, *map(abs, barriers.heights(tuple(state.values))), *memory.margin.epsilon.values()])
        memory.filter.decide(
            state.values,
            memory.filter.settings.high,
            decided.latent,
            memory=memory.pending,
            barriers=barriers,
            epsilon=dict.fromkeys(memory.margin.epsilon, _WIDTHS * widest),
            time=state.robot_time,
        )


def _report(
    state: StateMessage, verdict: Verdict, predicted: tuple[tuple[float, ...], ...], memory: RobotSession | None = None
) -> VerdictMessage:
    stationary_reason = memory.stationary_reason(verdict) if memory else ""
    remarks = [memory.margin.remark] if memory and memory.margin.remark else []
    if memory and memory.until_action > state.until_action:
        remarks.append(memory.delay.remark)
    if memory and state.sources and memory.scene.remark:
        remarks.append(memory.scene.remark)
    stationary_for = (
        f" The robot has stood for {memory.standing.seconds:.1f} s. {stationary_reason}."
        if memory and stationary_reason
        else ""
    )
    return VerdictMessage(
        epoch=state.epoch,
        tick=state.tick,
        robot_time=state.robot_time,
        publish_time=time.time(),
        status=verdict.status.value,
        sentence=" ".join([verdict.sentence, *remarks]) + stationary_for,
        action=tuple(verdict.action.tolist()),
        nominal=() if verdict.nominal is None else tuple(verdict.nominal.tolist()),
        slack=verdict.slack,
        active=verdict.active,
        h_now=verdict.h_now,
        h_next=verdict.h_next,
        margin=verdict.margin,
        solver=verdict.solver,
        microseconds=verdict.microseconds,
        predicted=predicted,
        coverage=memory.margin.coverage if memory else -1.0,
        promised=memory.margin.promised if memory else -1.0,
        model=memory.held.fingerprint if memory else "",
        ordered=memory.ordered if memory else "",
        stationary_for=memory.standing.seconds if memory else 0.0,
        stationary_reason=stationary_reason,
    )
