"""The safety filter: the nearest safe action to a wish, and a verdict about it, whatever comes in.

Each tick it looks for

    min over a, s   (a - wish)' W (a - wish) + rho |s|^2 + rho1 sum s
    subject to      p_i'(f + g a) + q_i >= (1 - eta) h_i(x) + epsilon_i - s_i   for every barrier i
                    action_low <= a <= action_high,   s >= 0

where p_i'x + q_i is the tangent of h_i at the predicted next state. The conditions are then evaluated at the model's
own prediction for the solution and posed anew about it if they do not hold there; the verdict reports what holds.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, final

import numpy as np

from safedpa.dynamics import AbstractDynamics, PhysicsModel
from safedpa.safety.barrier import AbstractBarrier
from safedpa.safety.car_stack import Stacks
from safedpa.safety.decision import Backup, Decision, Request, Tools
from safedpa.safety.highest import HighestProgram
from safedpa.safety.inputs import Plausible
from safedpa.safety.margins_in_force import Margins
from safedpa.safety.prediction import Prediction
from safedpa.safety.quadratic_program import QuadraticProgram
from safedpa.safety.search import DecisionError
from safedpa.safety.settings import FilterSettings
from safedpa.safety.verdict import Status, Verdict

__all__ = ["SafetyFilter"]


@final
class SafetyFilter:
    """Keeps h_i(x[t+1]) >= (1 - eta) h_i(x[t]) + epsilon_i for every barrier, as far as the actuators can.

    ``affine`` and ``step`` as in ``Prediction``; ``backup`` gives the action to take without a decision (default:
    ``settings.resting_action``). ``state_range`` and ``latent_range`` say what is believed; with a latent range that
    has entries a latent must be given. Not to be shared between threads: the solver's workspaces are reused.
    """

    def __init__(
        self,
        affine: Callable[..., Any] | Prediction,
        barriers: Sequence[AbstractBarrier],
        settings: FilterSettings,
        step: Callable[..., Any] | None = None,
        backup: Backup | None = None,
        *,
        state_range: Plausible | None = None,
        latent_range: Plausible | None = None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self.settings = settings
        self._barriers = tuple(barriers)
        low, high = settings.low, settings.high
        reach = settings.plausible_wish * (high - low)
        names = tuple(f"entry {index}" for index in range(len(low)))
        self.tools = Tools(
            settings=settings,
            prediction=affine if isinstance(affine, Prediction) else Prediction(affine, step),
            program=QuadraticProgram(low, high, settings.weight_vector),
            highest=HighestProgram(len(low)),
            stacks=Stacks(),
            margins=Margins(settings.epsilon),
            backup=backup,
            resting_action=tuple(settings.resting_action.tolist()),
            state_range=state_range,
            wish_range=Plausible(low - reach, high + reach, names),
            latent_range=latent_range,
            clock=clock,
        )

    @classmethod
    def for_model(
        cls,
        model: AbstractDynamics,
        settings: FilterSettings,
        barriers: Sequence[AbstractBarrier] = (),
        backup: Backup | None = None,
    ) -> SafetyFilter:
        """A filter that predicts with a model of this project and believes what lies within its bounds.

        A model with a latent wants one in every ``decide``.
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

    def decide(
        self,
        state: Any,
        wish: Any,
        latent: Any = None,
        *,
        memory: Any = None,
        barriers: Sequence[AbstractBarrier] | None = None,
        epsilon: Mapping[str, float] | None = None,
        stale: Sequence[str] = (),
    ) -> Verdict:
        """The verdict for ``state`` (states,), ``wish`` (actions,), ``latent`` (latents,); never raises on bad numbers.

        ``barriers`` replaces the filter's own for this call; ``epsilon`` overrides margins by kind; ``memory`` is what
        the model's actuators remember; ``stale`` names inputs that are too old: any of them brings the backup.
        """
        scene = self._barriers if barriers is None else barriers
        decision = Decision(self.tools, Request(state, wish, latent, memory, scene, epsilon or {}, stale))
        try:
            return decision.run()
        except DecisionError as failure:
            return decision.fallback(str(failure), failure.solver)
        except Exception as error:  # noqa: BLE001 - a user's function may raise anything, and the robot must still brake
            return decision.fallback(f"{type(error).__name__}: {error}", "not run")

    def hold(self, absent: str, state: Any, latent: Any = None, **known: Any) -> Verdict:
        """The verdict where nothing but the wish is missing, for a robot that has no stand; arguments as in ``decide``.

        The resting action stands in for the wish, and the filter changes it as it would any: state and latent are good,
        so the barriers can be kept. The verdict has no wish and says why. With anything else amiss it is the fallback.
        """
        verdict = self.decide(state, self.tools.resting_action, latent, **known)
        if verdict.status is Status.fallback:
            return replace(verdict, wish=None)
        status = Status.corrected if verdict.status is Status.passed else verdict.status
        said = f"{verdict.reason} {absent[:1].upper()}{absent[1:]}: the resting action stood in for it.".strip()
        return replace(verdict, wish=None, status=status, reason=said)

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
        stands: bool = True,
    ) -> Verdict:
        """The verdict while the robot is to stop for ``reason``, whatever is wished; other arguments as in ``decide``.

        Where the backup action brings the robot to rest (``stands``) it is taken as it is: braking straight lowers no
        h, and a robot that was stopped must not be led anywhere. A robot that has no stand, such as a pendulum, would
        leave its corridor: there the resting action is wished, and the filter changes it as it would any wish; the
        verdict is ``stopped`` where that keeps every condition, and says what else came out where it does not.
        """
        scene = self._barriers if barriers is None else barriers
        if stands:
            wish = self.tools.resting_action
            request = Request(state, wish, latent, memory, scene, epsilon or {}, stale)
            return replace(Decision(self.tools, request).stopped(reason), wish=None)
        verdict = self.decide(
            state,
            self.tools.resting_action,
            latent,
            memory=memory,
            barriers=scene,
            epsilon=epsilon,
            stale=stale,
        )
        if verdict.status not in (Status.passed, Status.corrected):
            return verdict
        return replace(verdict, status=Status.stopped, reason=f"Reason: {reason}. The barriers are kept.")


def _latent_range(model: AbstractDynamics) -> Plausible:
    """The bounds of a physics model's free parameters; a learned latent has none."""
    names = model.latent_names
    if isinstance(model, PhysicsModel):
        parameters = [model.parameters[name] for name in names]
        return Plausible(np.array([p.low for p in parameters]), np.array([p.high for p in parameters]), names)
    return Plausible(np.full(len(names), -np.inf), np.full(len(names), np.inf), names)
