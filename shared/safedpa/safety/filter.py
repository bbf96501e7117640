"""The safety filter: returns the safe action nearest to a nominal action, and a verdict, whatever the inputs are.

Each tick it solves

    min over a, s   (a - nominal)' W (a - nominal) + rho |s|^2 + rho1 sum s
    subject to      p_i'(f + g a) + q_i >= (1 - eta) h_i(x) + epsilon_i - s_i   for every barrier i
                    action_low <= a <= action_high,   s >= 0

where p_i'x + q_i is the tangent of h_i at the predicted next state. The constraints are then evaluated at the model's
own prediction for the solution, and linearised again there if they do not hold; the verdict reports what holds.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from threading import Lock
from typing import Any, final

import numpy as np

from safedpa.dynamics import AbstractDynamics, PhysicsModel
from safedpa.errors import InputError, described
from safedpa.result import one_line
from safedpa.safety.barriers.base import AbstractBarrier
from safedpa.safety.barriers.stack import BarrierSetCache
from safedpa.safety.checks.compatibility import (
    check_backup,
    check_barriers,
    check_margins,
    check_settings,
    check_settings_of_functions,
)
from safedpa.safety.compiled_decision import CompiledDecisions
from safedpa.safety.decision import Backup, Decision, FilterContext, FilterInput
from safedpa.safety.margins.active import ActiveMargins
from safedpa.safety.prediction.predictor import Prediction
from safedpa.safety.settings import FilterSettings
from safedpa.safety.solver.candidates import HeldSolution
from safedpa.safety.solver.maximin_lp import MaxMinProgram
from safedpa.safety.solver.qp import QuadraticProgram
from safedpa.safety.solver.sqp import DecisionError
from safedpa.safety.validation import FiniteClock, Plausible
from safedpa.safety.verdict import Status, Verdict, resting_verdict

__all__ = ["SafetyFilter"]

_TWO_AT_ONCE = (
    "another decision of this filter is in progress, in another thread or within one of its own functions; "
    "give every thread a filter of its own"
)


@final
class SafetyFilter:
    """Enforces h_i(x[t+1]) >= (1 - eta) h_i(x[t]) + epsilon_i for every barrier, as far as the actuators can.

    ``affine`` and ``step`` are as in ``Prediction``. ``backup`` returns the action that is used when no decision can be
    computed (default: ``settings.resting_action``). Inputs outside ``state_range`` and ``latent_range`` are refused; a
    latent range with entries makes the latent mandatory. ``barriers`` is None if every call of ``decide`` passes them.

    An instance must not be shared between threads, since the solver's workspaces are reused: a concurrent call returns
    the resting action and says so. ``copy.deepcopy`` makes an independent filter with the same settings.

    Raises InputError for settings of another system, for bounds that the model's actions cannot take, for an empty list
    of barriers, for barriers of other states, for a margin that belongs to none of them, and for a backup of another
    size.

    Example: a mass before a wall at 1 m, 20 Hz, that may accelerate by 1 m/s2.

        >>> def affine(x):
        ...     return np.array([x[0] + 0.05 * x[1], x[1]]), np.array([[0.00125], [0.05]])
        >>> room = safedpa.FunctionBarrier(lambda x: 1.0 - x[0] - max(x[1], 0.0) ** 2 / 1.6, kind="wall")
        >>> settings = safedpa.FilterSettings(action_low=(-1.0,), action_high=(1.0,), eta=0.1)
        >>> safe = safedpa.SafetyFilter(affine, [room], settings)
        >>> verdict = safe.decide([0.5, 0.8], nominal=[1.0])
        >>> verdict.status.value, verdict.action.round(1).tolist()
        ('corrected', [-0.6])
    """

    def __init__(
        self,
        affine: Callable[..., Any] | Prediction,
        barriers: Sequence[AbstractBarrier] | None,
        settings: FilterSettings,
        step: Callable[..., Any] | None = None,
        backup: Backup | None = None,
        *,
        state_range: Plausible | None = None,
        latent_range: Plausible | None = None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        prediction = affine if isinstance(affine, Prediction) else Prediction(affine, step)
        for what, given_range in (("state_range", state_range), ("latent_range", latent_range)):
            if given_range is not None and not isinstance(given_range, Plausible):
                raise InputError(f"{what}: got {type(given_range).__name__}, wanted Plausible(low, high, names)")
        states = _names_of_states(prediction, state_range)
        own = check_barriers(barriers, states)
        # Functions do not name their system: what they do not say cannot be compared, and is then not assumed.
        if prediction.system is None:
            check_settings_of_functions(settings, states, own)
        else:
            check_settings(settings, prediction.system)
        check_margins(settings.epsilon, own)
        check_backup(backup, len(settings.action_low))
        self.settings = settings
        # All checks run at construction: a mistake in the configuration must show before the robot drives.
        self._barriers = own or ()
        self._one_at_a_time = Lock()
        low, high = settings.low, settings.high
        # A nominal action far outside the actuator range is more likely a wrong unit than a request: it is refused, not
        # clipped.
        reach = settings.plausible_nominal * (high - low)
        names = tuple(f"entry {index}" for index in range(len(low)))
        program = QuadraticProgram(low, high, settings.weight_vector)
        self.tools = FilterContext(
            settings=settings,
            prediction=prediction,
            program=program,
            compiled=CompiledDecisions(settings, program, prediction),
            maximin_lp=MaxMinProgram(len(low)),
            barrier_sets=BarrierSetCache(states),
            margins=ActiveMargins(settings.epsilon),
            backup=backup,
            resting_action=tuple(settings.resting_action.tolist()),
            state_range=state_range,
            nominal_range=Plausible(low - reach, high + reach, names),
            latent_range=latent_range,
            # A user's clock may raise or return text; only the monotonic clock of the standard library is used as it
            # is.
            clock=clock if clock is time.perf_counter else FiniteClock(clock),
        )
        if self.tools.compiled is not None:
            if clock is time.perf_counter:  # the only clock that C reads
                self.tools.compiled.accept(state_range, self.tools.nominal_range, latent_range)
            self.tools.compiled.prepare(own, 0 if state_range is None else len(state_range.names))

    def __repr__(self) -> str:
        settings, scene = self.settings, [name for barrier in self._barriers for name in barrier.names]
        return one_line(
            "SafetyFilter",
            {
                "system": settings.system or "of one's own",
                "actions": len(settings.action_low),
                "eta": settings.eta,
                "barriers": ", ".join(scene) or "given with each decision",
            },
        )

    @classmethod
    def for_model(
        cls,
        model: AbstractDynamics,
        settings: FilterSettings,
        barriers: Sequence[AbstractBarrier] | None = None,
        backup: Backup | None = None,
    ) -> SafetyFilter:
        """A filter that predicts with a model of this project and refuses inputs outside the model's bounds.

        Without ``barriers`` every call of ``decide`` passes them. A model with a latent needs one in every call.
        """
        system = model.system
        if isinstance(model, PhysicsModel):
            # 3 to 30 ms now, rather than within a decision; what fails here is reported by the decision that needs it
            with contextlib.suppress(Exception):
                model.record_scalar_step()
        return cls(
            Prediction.of_model(model),
            barriers,
            settings,
            backup=backup,
            # The system's own bounds: outside them the model was never identified.
            state_range=Plausible(system.state_low, system.state_high, system.state_names),
            latent_range=_latent_range(model),
        )

    @property
    def barriers(self) -> tuple[AbstractBarrier, ...]:
        """The barriers that ``decide`` uses when it is given none."""
        return self._barriers

    def __reduce__(self) -> tuple[Any, ...]:
        """A copy, here or in another process, is constructed again: with its own solver workspace and lock."""
        tools = self.tools
        ranges = tools.state_range, tools.latent_range
        return _rebuilt, (tools.prediction, self._barriers or None, self.settings, tools.backup, *ranges, tools.clock)

    def decide(
        self,
        state: Any,
        nominal: Any,
        latent: Any = None,
        *,
        memory: Any = None,
        barriers: Sequence[AbstractBarrier] | None = None,
        epsilon: Mapping[str, float] | None = None,
        stale: Sequence[str] = (),
        time: float | None = None,
        held_solution: HeldSolution | None = None,
        deadline: float | None = None,
        evaluations: int | None = None,
    ) -> Verdict:
        """Returns the verdict for ``state`` (states,), ``nominal`` (actions,), ``latent`` (latents,); raises nothing.

        ``barriers`` replaces the filter's own for this call. ``epsilon`` overrides margins by kind. ``memory`` is the
        state of the model's actuators. ``stale`` names inputs that are too old: each of them leads to the backup
        action. ``time`` [s] is the time since the start of the run; a model that depends on it uses the backup without
        it. ``held_solution`` is this robot's last least-violation search; without it every tick runs the full search.

        A search that is not finished ``deadline`` [s] after the call, or after ``evaluations`` of model and barriers,
        ends with the best candidate so far, and the status that is true of it; one evaluation may exceed the deadline.
        ``evaluations`` repeats exactly, ``deadline`` depends on the machine.
        """
        if type(stale) is tuple and not stale and deadline is None and evaluations is None:
            verdict = self._usual(state, nominal, latent, barriers, epsilon, time, memory)
            if verdict is not None:
                return verdict
        request = self._request(state, nominal, latent, memory, barriers, epsilon, stale, time, held_solution)
        request.deadline, request.evaluations = deadline, evaluations
        return self._answer(_decided, request)

    def _usual(
        self, state: Any, nominal: Any, latent: Any, barriers: Any, epsilon: Any, time: Any, memory: Any
    ) -> Verdict | None:
        """The verdict of the compiled search where nothing is unusual; None: a ``Decision`` has to be made."""
        tools, scene = self.tools, self._barriers if barriers is None else barriers
        if tools.compiled is None or not self._one_at_a_time.acquire(blocking=False):
            return None
        try:
            found: Verdict | None = tools.compiled.verdict(tools, state, nominal, latent, scene, epsilon, time, memory)
            return found
        except Exception:  # noqa: BLE001 - whatever it is, the decision meets it again and reports it
            return None
        finally:
            self._one_at_a_time.release()

    def hold(self, absent: str, state: Any, latent: Any = None, **known: Any) -> Verdict:
        """Returns the verdict when only the nominal action is missing, for a robot that has no safe standstill.

        The resting action replaces the nominal action and is filtered like any other: state and latent are valid, so
        the barriers can be enforced. The verdict has no nominal action and says why; any other problem is a fallback.
        """
        # Filtered, not applied as it is: the resting action of a pendulum lets it fall.
        verdict = self.decide(state, self.tools.resting_action, latent, **known)
        if verdict.status is Status.fallback:
            return replace(verdict, nominal=None)
        # "passed" would claim that a nominal action was passed on, and there was none.
        status = Status.corrected if verdict.status is Status.passed else verdict.status
        notice = f"{verdict.reason} {absent[:1].upper()}{absent[1:]}: the resting action stood in for it.".strip()
        return replace(verdict, nominal=None, status=status, reason=notice)

    def stop(
        self,
        reason: str,
        state: Any,
        latent: Any = None,
        *,
        memory: Any = None,
        barriers: Sequence[AbstractBarrier] | None = None,
        epsilon: Mapping[str, float] | None = None,
        stale: Sequence[str] = (),
        can_stop: bool = True,
        time: float | None = None,
    ) -> Verdict:
        """Returns the verdict while the robot is ordered to stop for ``reason``; other arguments as in ``decide``.

        If the backup action brings the robot to rest (``stands``), it is used as it is: braking straight lowers no h,
        and a stopped robot must not be steered. A robot without a safe standstill, such as a pendulum, would leave its
        corridor: there the resting action is filtered like a nominal action. The verdict is ``stopped`` if the result
        satisfies every constraint, and otherwise keeps the status of the result.
        """
        if can_stop:
            nominal = self.tools.resting_action
            # A stop needs no valid nominal action; the resting action only fills its place in the checks.
            request = self._request(state, nominal, latent, memory, barriers, epsilon, stale, time)
            return replace(self._answer(lambda decision: decision.stopped(reason), request), nominal=None)
        verdict = self.decide(
            state,
            self.tools.resting_action,
            latent,
            memory=memory,
            barriers=barriers,
            epsilon=epsilon,
            stale=stale,
            time=time,
        )
        # A violation must stay visible, also while the robot is ordered to stop.
        if verdict.status not in (Status.passed, Status.corrected):
            return verdict
        return replace(verdict, status=Status.stopped, reason=f"Reason: {reason}. The barriers are satisfied.")

    def _request(
        self,
        state: Any,
        nominal: Any,
        latent: Any,
        memory: Any,
        barriers: Any,
        epsilon: Any,
        stale: Any,
        time: Any,
        held_solution: HeldSolution | None = None,
    ) -> FilterInput:
        scene = self._barriers if barriers is None else barriers
        return FilterInput(
            state, nominal, latent, memory, scene, {} if epsilon is None else epsilon, stale, time, held_solution
        )

    def _answer(self, answer: Callable[[Decision], Verdict], request: FilterInput) -> Verdict:
        """Runs one decision, unless one is in progress: two at once would overwrite each other's workspaces."""
        # Not blocking: a control loop must get an action now, not when another thread has finished.
        if not self._one_at_a_time.acquire(blocking=False):
            return resting_verdict(self.settings.resting_action, _TWO_AT_ONCE)
        try:
            return answer(Decision(self.tools, request))
        except Exception as error:  # noqa: BLE001 - whatever the inputs were, the robot must brake
            return resting_verdict(self.settings.resting_action, f"{type(error).__name__}")
        finally:
            self._one_at_a_time.release()


def _rebuilt(
    prediction: Prediction,
    barriers: Sequence[AbstractBarrier] | None,
    settings: FilterSettings,
    backup: Backup | None,
    state_range: Plausible | None,
    latent_range: Plausible | None,
    clock: Callable[[], float],
) -> SafetyFilter:
    return SafetyFilter(
        prediction, barriers, settings, None, backup, state_range=state_range, latent_range=latent_range, clock=clock
    )


def _decided(decision: Decision) -> Verdict:
    try:
        return decision.run()
    except DecisionError as failure:
        return decision.fallback(str(failure), failure.solver)
    except Exception as error:  # noqa: BLE001 - a user's function may raise anything, and the robot must still brake
        return decision.fallback(described(error), "not run")


def _names_of_states(prediction: Prediction, state_range: Plausible | None) -> tuple[str, ...]:
    if prediction.system is not None:
        return prediction.system.state_names
    return () if state_range is None else state_range.names


def _latent_range(model: AbstractDynamics) -> Plausible:
    """The bounds of a physics model's free parameters; a learned latent has none."""
    names = model.latent_names
    if isinstance(model, PhysicsModel):
        parameters = [model.parameters[name] for name in names]
        return Plausible(np.array([p.low for p in parameters]), np.array([p.high for p in parameters]), names)
    # Infinite bounds still check the number of entries and refuse NaN.
    return Plausible(np.full(len(names), -np.inf), np.full(len(names), np.inf), names)
