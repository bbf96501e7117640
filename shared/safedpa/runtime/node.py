"""The node of the safety filter: computes action[k] and its verdict from state[k], latent[k] and nominal action[k].

An action is sent in time in any case. If the nominal action is missing or the latent is too old, the filter sends the
backup action.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from typing import Any, ClassVar, final

from safedpa.bus import (
    ACTION,
    LATENT,
    NOMINAL,
    SURROUNDINGS,
    TAKEOVER,
    VERDICT,
    ActionMessage,
    Inputs,
    LatentMessage,
    ModelMessage,
    NominalMessage,
    Outputs,
    Stale,
    StateMessage,
    SurroundingsMessage,
    Topic,
    VerdictMessage,
)
from safedpa.bus.messages.messages import header
from safedpa.bus.service.model_versions import ModelNode, ModelVersions
from safedpa.dynamics import PhysicsModel, fingerprint
from safedpa.runtime.calibrated_model import CalibratedModel, accept_offer, checked_calibration, uncalibrated
from safedpa.runtime.robot_session import NO_BARRIERS, SHIPPED_LIMITS, LastDecision, RobotSession, state_too_old
from safedpa.runtime.stop_orders import StopOrders
from safedpa.safety.barriers.base import AbstractBarrierSet
from safedpa.safety.margins.calibration import MarginCalibration
from safedpa.safety.margins.transition import margin_change, min_h_by_kind
from safedpa.safety.session.state_limits import StateLimits
from safedpa.safety.settings import FilterSettings
from safedpa.safety.verdict import Status, Verdict, resting_verdict

# m/s; a car that is slower is stationary.
_IS_STATIONARY = 0.02
# Factor of a margin that no action can satisfy, relative to the largest |h| and to the active margins.
_IMPOSSIBLE_FACTOR = 1e3


@final
class SafetyFilterNode(ModelNode[CalibratedModel]):
    """Filters the nominal actions of each robot. With ``settings.enabled`` false it passes them on unchanged.

    A new model brings its own margin, and the margin monitor starts again. A latent of another model is not used: the
    filter sends the backup action until both services have the same model. Raises InputError if the calibration belongs
    to another model, the settings to another robot, or if there are no barriers for this robot.
    """

    name = "safety_filter"
    inputs = (LATENT, NOMINAL)
    outputs = (ACTION, VERDICT, TAKEOVER)
    sensor_inputs = (SURROUNDINGS,)
    share = 0.5
    # A latent may be one tick old, as in the policy: waiting for it would add the adaptation's time to every action.
    # The margin monitor measures the error that follows.
    slack: ClassVar[Mapping[Topic, int]] = {LATENT: 1}

    def __init__(
        self,
        model: PhysicsModel,
        settings: FilterSettings | None = None,
        calibration: MarginCalibration | None = None,
        orders: StopOrders | None = None,
        limits: StateLimits | str | None = SHIPPED_LIMITS,
    ) -> None:
        self._limits = limits
        self.orders = orders or StopOrders()
        """The stop orders in force."""
        self._settings = settings or FilterSettings.for_robot(model.system)
        known = calibration or uncalibrated(self._settings, fingerprint(model))
        first = CalibratedModel(
            model, fingerprint(model), checked_calibration(known, fingerprint(model), self._settings)
        )
        RobotSession.create(first, self._settings)  # raises for another robot's settings now, not at the first tick
        self._versions = ModelVersions(self.name, first, first.fingerprint, self._load, self._predicted)
        self._robots: dict[str, RobotSession] = {}
        self._broken: dict[str, RobotSession] = {}
        """Sessions of robots whose last step failed; the next session continues what they learned."""
        self._rehearsed: PhysicsModel | None = None
        """Model of the last rehearsed decision; robots with equal periods share it."""

    def prepare(self, robot: str, state: StateMessage) -> None:  # noqa: D102
        if self._versions.begin(robot, state) and robot in self._robots:
            self._robots[robot].changed_at = state.tick
        session = self._robots.get(robot)
        # The model predicts over one period, so a robot that changes its period needs a new session.
        if session is not None and session.model.period != state.period:
            self._broken[robot], session = session, None
        if session is None:
            broken = self._broken.get(robot)
            before = None if broken is None else broken.margin.epsilon
            session = RobotSession.create(self._versions.of(robot), self._settings, before, state.period, self._limits)
            if broken is not None and _same_margin(broken, session):
                session.margin = broken.margin
                session.margin.expect(None)
            session.inherit_from(broken)
            self._robots[robot] = session
            self._broken.pop(robot, None)
        session.observe_state(state)

    def _with_latent(self, robot: str, state: StateMessage, inputs: Inputs) -> RobotSession:
        """Returns the robot's session; a new one from the first latent of a new model on.

        The latent of a tick may be one tick old and then belongs to the old model. Old model, latent and margin decide
        together until a latent of the new model arrives, for at most as long as a missing latent is tolerated.
        """
        session, held = self._robots[robot], self._versions.of(robot)
        if session.held is held:
            return session
        latent = inputs[LATENT]
        of_before = not isinstance(latent, LatentMessage) or latent.model == session.held.fingerprint
        if of_before and session.held.fingerprint != held.fingerprint and session.may_use_previous_model(state):
            return session
        created = RobotSession.create(held, self._settings, session.margin.epsilon, state.period, self._limits)
        created.inherit_from(session)
        self._robots[robot] = created
        self.prepare(robot, state)
        return self._robots[robot]

    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:  # noqa: D102
        session = self._robots.get(robot)
        if session is None or session.prepared != (state.epoch, state.tick):
            self.prepare(robot, state)
        session = self._with_latent(robot, state, inputs)
        state = session.accept(state)  # from here on the believed one
        if state.sources:
            seen = inputs[SURROUNDINGS]
            assert isinstance(seen, SurroundingsMessage | Stale)
            session.observe_surroundings(state, seen)
        nominal = inputs[NOMINAL]
        latent, stale = session.usable_latent(state, inputs)
        absent = f"the nominal action ({nominal.sentence})" if isinstance(nominal, Stale) else ""
        holds = bool(absent and not session.scene.can_stop)
        if absent and not holds:
            stale.append(absent)
        stale.extend(state_too_old(state))
        if isinstance(session.barriers, str):
            stale.append(f"the {session.barriers}")
        barriers = NO_BARRIERS if isinstance(session.barriers, str) else session.barriers
        known: dict[str, Any] = {
            "memory": session.pending,
            "barriers": barriers,
            "epsilon": session.epsilon,
            "stale": stale,
            "time": state.robot_time,
        }
        session.ordered = self.orders.reason(robot)
        if session.latched and session.latch_ordered and not session.ordered:
            session.confirm()  # by ``go``; the next measured state is believed
        stops = session.ordered or (session.scene.yields_to if state.sources and not stale else "")
        if session.braking:
            verdict = session.brake(state, latent, session.braking, **known)
        elif stops:
            verdict = session.filter.stop(stops, state.values, latent, can_stop=session.scene.can_stop, **known)
        elif holds:
            verdict = session.filter.hold(f"{absent} is stale", state.values, latent, **known)
        else:
            nominal_values = nominal.values if isinstance(nominal, NominalMessage) else None
            verdict = session.filter.decide(
                state.values, nominal_values, latent, **known, held_solution=session.held_solution
            )
            verdict = session.escape_boundary_layer(state, verdict, latent)
            verdict = session.rest_in_dead_band(
                state,
                verdict,
                latent,
                lambda: session.filter.decide(state.values, self._settings.resting_action, latent, **known),
            )
        session.decision = LastDecision(state, latent, verdict)
        return {ACTION: ActionMessage(**header(state), values=tuple(verdict.action.tolist()))}

    def afterwards(self, robot: str) -> Outputs:
        """Returns the verdict, with the next states that the model predicts; the action was already sent."""
        session = self._robots[robot]
        assert session.decision is not None
        state, latent, verdict = session.decision
        predicted = session.predict_states(state, verdict, latent)
        session.watch_deadlock(state, predicted)
        if session.latched and not session.latch_ordered:
            # Stored like any order, so that a restarted filter does not release the robot.
            self.orders.latch(robot, session.latched)
            session.latch_ordered = True
        if not (session.rehearsed or isinstance(session.barriers, str) or verdict.status is Status.fallback):
            session.rehearsed = True
            if session.model is not self._rehearsed:
                self._rehearsed = session.model
                _rehearse(session, session.decision, session.barriers)
        return {VERDICT: _report(state, verdict, predicted, session), **self._answer(robot, state)}

    def newest(self, robot: str) -> StateMessage | None:  # noqa: D102
        session = self._robots.get(robot)
        return None if session is None or session.decision is None else session.decision.state

    def begin_shutdown(self) -> None:  # noqa: D102
        self.orders.end("the safety filter is about to end")

    def at_rest(self, robot: str) -> bool:
        """Whether the robot has stopped by order; true at once for a robot without a speed, which cannot stop."""
        session = self._robots.get(robot)
        if session is None or session.decision is None:
            return False
        state, _, verdict = session.decision
        speeds = [state.values[index] for index in session.speeds if index < len(state.values)]
        return verdict.status in (Status.stopped, Status.fallback) and all(
            abs(speed) <= _IS_STATIONARY for speed in speeds
        )

    def rescue(self, robot: str, state: StateMessage, reason: str) -> Outputs:
        """Returns the backup action after a failed step, and a verdict with the reason.

        Uses the scene's own backup if the robot has one, otherwise the resting action.
        """
        # The session may be the cause of the failure, so the next tick starts another one. It takes over what was
        # learned: a failure must not narrow the margin, forget a delay, or make the next state look implausible.
        broken = self._robots.pop(robot, None)
        if broken is not None:
            self._broken[robot] = broken
        known = self._broken.get(robot)
        action = self._settings.resting_action if known is None else known.last_resort(state)
        verdict = resting_verdict(action, reason)
        return {
            ACTION: ActionMessage(**header(state), values=tuple(verdict.action.tolist())),
            VERDICT: _report(state, verdict, ()),
        }

    def forget(self, robot: str) -> None:  # noqa: D102
        self._robots.pop(robot, None)
        self._broken.pop(robot, None)

    def _load(self, robot: str, offer: ModelMessage) -> CalibratedModel:
        """Loads the offered model and margin, and tries them at the robot's last decision.

        Raises InputError if they are not usable.
        """
        held = accept_offer(offer, self._versions.of(robot), self._settings)
        trial, session = RobotSession.create(held, self._settings), self._robots.get(robot)
        if session is not None and session.decision is not None:
            trial.sync_actuators(session.decision.state)
            trial.check_decision(session.decision, session.barriers)
        return held

    def _predicted(self, robot: str, held: CalibratedModel) -> str:
        """Describes the effect of an offered model's margin at the robot's current state."""
        session, current = self._robots.get(robot), self._versions.of(robot).calibration.epsilon
        if session is None or session.decision is None or isinstance(session.barriers, str):
            return margin_change(current, held.calibration.epsilon, {}, self._settings.eta)
        h = min_h_by_kind(session.barriers, session.decision.state.values)
        coming, _ = held.margin_over(session.model.period, self._settings)
        return margin_change(session.margin.epsilon, coming.epsilon, h, self._settings.eta)


def _same_margin(before: RobotSession, now: RobotSession) -> bool:
    """Whether the margin monitor may continue: same model, same calibration, and no longer steps than before."""
    alike = before.held is now.held and before.margin.longer == now.margin.longer
    return alike and before.model.period >= now.model.period


def _rehearse(session: RobotSession, decided: LastDecision[StateMessage], barriers: AbstractBarrierSet) -> None:
    """Warms up the fallback path of a decision before the robot drives; changes no verdict.

    The first decision for which no action satisfies every condition takes 5 ms, the following ones 0.5 ms, because
    solvers allocate workspaces, equations are generated and modules imported. With a period of 5 ms there is no time
    for that later. The warm-up decides with margins that no action satisfies and discards the verdict.
    """
    state = decided.state
    with suppress(Exception):  # an exception in a user's equations must not stop a robot because of a warm-up
        session.model.record_scalar_step()
        widest = max([1.0, *map(abs, barriers.h_floats(tuple(state.values))), *session.margin.epsilon.values()])
        session.filter.decide(
            state.values,
            session.filter.settings.high,
            decided.latent,
            memory=session.pending,
            barriers=barriers,
            epsilon=dict.fromkeys(session.margin.epsilon, _IMPOSSIBLE_FACTOR * widest),
            time=state.robot_time,
        )


def _report(
    state: StateMessage, verdict: Verdict, predicted: tuple[tuple[float, ...], ...], session: RobotSession | None = None
) -> VerdictMessage:
    stationary_reason = session.stationary_reason(verdict) if session else ""
    remarks = [session.margin.remark] if session and session.margin.remark else []
    if session and session.until_action > state.until_action:
        remarks.append(session.delay.remark(session.margin.coverage, session.margin.promised))
    if session and state.sources and session.scene.remark:
        remarks.append(session.scene.remark)
    deadlock_sentence = (
        f" The robot has been stationary for {session.deadlock_detector.seconds:.1f} s. {stationary_reason}."
        if session and stationary_reason
        else ""
    )
    return VerdictMessage(
        **header(state),
        status=verdict.status.value,
        sentence=" ".join([verdict.sentence, *remarks]) + deadlock_sentence,
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
        coverage=session.margin.coverage if session else -1.0,
        promised=session.margin.promised if session else -1.0,
        model=session.held.fingerprint if session else "",
        ordered=session.ordered if session else "",
        stationary_for=session.deadlock_detector.seconds if session else 0.0,
        stationary_reason=stationary_reason,
    )
