"""The safety filter: the nearest safe action to a nominal action, and a verdict about it, whatever comes in.

Each tick it looks for

    min over a, s   (a - nominal)' W (a - nominal) + rho |s|^2 + rho1 sum s
    subject to      p_i'(f + g a) + q_i >= (1 - eta) h_i(x) + epsilon_i - s_i   for every barrier i
                    action_low <= a <= action_high,   s >= 0

where p_i'x + q_i is the tangent of h_i at the predicted next state. The conditions are then evaluated at the model's
own prediction for the solution and posed again about it if they do not hold there; the verdict reports what holds.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from threading import Lock
from typing import Any, final

import numpy as np

from safedpa.dynamics import AbstractDynamics, PhysicsModel
from safedpa.errors import InputError
from safedpa.safety.barriers.base import AbstractBarrier
from safedpa.safety.barriers.stack import BarrierSetCache
from safedpa.safety.checks.compatibility import (
    check_backup,
    check_barriers,
    check_margins,
    check_settings,
    check_settings_of_functions,
)
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
    "another decision of this filter is under way, in another thread or within one of its own functions; "
    "give every thread a filter of its own"
)


@final
class SafetyFilter:
    """Keeps h_i(x[t+1]) >= (1 - eta) h_i(x[t]) + epsilon_i for every barrier, as far as the actuators can.

    ``affine`` and ``step`` as in ``Prediction``; ``backup`` gives the action to take without a decision (default:
    ``settings.resting_action``). ``state_range`` and ``latent_range`` say what is believed; with a latent range that
    has entries a latent must be given. ``barriers`` is None where every decision brings its own.

    Not to be shared between threads: the solver's workspaces are reused. Who asks while another thread's decision is
    under way gets the resting action and is told so. ``copy.deepcopy`` makes another filter of the same.

    Raises InputError for settings of another system or with bounds that the model's actions cannot take, for barriers
    that read other states, for none, for a margin that belongs to none of them, and for a backup of another size.
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
        for what, believed in (("state_range", state_range), ("latent_range", latent_range)):
            if believed is not None and not isinstance(believed, Plausible):
                raise InputError(f"{what}: got {type(believed).__name__}, wanted Plausible(low, high, names)")
        states = _names_of_states(prediction, state_range)
        own = check_barriers(barriers, states)
        if prediction.system is None:
            check_settings_of_functions(settings, states, own)
        else:
            check_settings(settings, prediction.system)
        check_margins(settings.epsilon, own)
        check_backup(backup, len(settings.action_low))
        self.settings = settings
        self._barriers = own or ()
        self._one_at_a_time = Lock()
        low, high = settings.low, settings.high
        reach = settings.plausible_nominal * (high - low)
        names = tuple(f"entry {index}" for index in range(len(low)))
        self.tools = FilterContext(
            settings=settings,
            prediction=prediction,
            program=QuadraticProgram(low, high, settings.weight_vector),
            highest=MaxMinProgram(len(low)),
            stacks=BarrierSetCache(states),
            margins=ActiveMargins(settings.epsilon),
            backup=backup,
            resting_action=tuple(settings.resting_action.tolist()),
            state_range=state_range,
            nominal_range=Plausible(low - reach, high + reach, names),
            latent_range=latent_range,
            clock=clock if clock is time.perf_counter else FiniteClock(clock),
        )

    @classmethod
    def for_model(
        cls,
        model: AbstractDynamics,
        settings: FilterSettings,
        barriers: Sequence[AbstractBarrier] | None = None,
        backup: Backup | None = None,
    ) -> SafetyFilter:
        """A filter that predicts with a model of this project and believes what lies within its bounds.

        Without ``barriers`` every ``decide`` brings its own. A model with a latent wants one in every ``decide``.
        """
        system = model.system
        return cls(
            Prediction.of_model(model),
            barriers,
            settings,
            backup=backup,
            state_range=Plausible(system.state_low, system.state_high, system.state_names),
            latent_range=_latent_range(model),
        )

    @property
    def barriers(self) -> tuple[AbstractBarrier, ...]:
        """The barriers that ``decide`` keeps where it is given none."""
        return self._barriers

    def __reduce__(self) -> tuple[Any, ...]:
        """A copy, here or in another process, is made again: with a solver's memory and a turn of its own."""
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
        searched: HeldSolution | None = None,
    ) -> Verdict:
        """The verdict for ``state`` (states,), ``nominal`` (actions,), ``latent`` (latents,); raises nothing.

        ``barriers`` replaces the filter's own for this call; ``epsilon`` overrides margins by kind; ``memory`` is what
        the model's actuators remember; ``stale`` names inputs that are too old: any of them brings the backup.
        ``time`` [s] since the start of the run; a model that depends on it has the backup without. ``searched`` is what
        is remembered of this robot's last search for the least-violation action; without, every tick searches wholly.
        """
        request = self._request(state, nominal, latent, memory, barriers, epsilon, stale, time, searched)
        return self._answer(_decided, request)

    def hold(self, absent: str, state: Any, latent: Any = None, **known: Any) -> Verdict:
        """The verdict where nothing but the nominal action is missing, for a robot that has no stand; arguments as in ``decide``.

        The resting action stands in for the nominal action, and the filter changes it as it would any: state and latent are good,
        so the barriers can be kept. The verdict has no nominal action and says why. With anything else amiss it is the fallback.
        """
        verdict = self.decide(state, self.tools.resting_action, latent, **known)
        if verdict.status is Status.fallback:
            return replace(verdict, nominal=None)
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
        stationary_for: bool = True,
        time: float | None = None,
    ) -> Verdict:
        """The verdict while the robot is to stop for ``reason``, whatever action is requested; other arguments as in ``decide``.

        Where the backup action brings the robot to rest (``stands``) it is taken as it is: braking straight lowers no
        h, and a robot that was stopped must not be led anywhere. A robot that has no stand, such as a pendulum, would
        leave its corridor: there the resting action is requested, and the filter changes it as it would any nominal action; the
        verdict is ``stopped`` where that satisfies every condition, and says what else came out where it does not.
        """
        if stationary_for:
            nominal = self.tools.resting_action
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
        if verdict.status not in (Status.passed, Status.corrected):
            return verdict
        return replace(verdict, status=Status.stopped, reason=f"Reason: {reason}. The barriers are kept.")

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
        searched: HeldSolution | None = None,
    ) -> FilterInput:
        scene = self._barriers if barriers is None else barriers
        return FilterInput(
            state, nominal, latent, memory, scene, {} if epsilon is None else epsilon, stale, time, searched
        )

    def _answer(self, answer: Callable[[Decision], Verdict], request: FilterInput) -> Verdict:
        """What a decision answers, if none is under way: two at once would share their workspaces, and mix."""
        if not self._one_at_a_time.acquire(blocking=False):
            return resting_verdict(self.settings.resting_action, _TWO_AT_ONCE)
        try:
            return answer(Decision(self.tools, request))
        except Exception as error:  # noqa: BLE001 - whatever came in, the robot must brake
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
        return decision.fallback(f"{type(error).__name__}: {error}", "not run")


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
    return Plausible(np.full(len(names), -np.inf), np.full(len(names), np.inf), names)
