"""A decision by the compiled search: the same as by ``decision`` and ``solver``, in one call.

``CompiledDecisions`` belongs to one filter. It declines, and Python decides, wherever C has no answer: for three or
more actions, actuators with memory, budgets, barriers that are no equations, and numbers that are not finite.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from math import inf, isnan, nan
from typing import Any, Final, NamedTuple, final

import numpy as np

from safedpa.native import NoKernelError
from safedpa.native.library import load_module, remark, why_not_compiled
from safedpa.safety.barriers.base import AbstractBarrier, AbstractBarrierSet, CachingBarrierSet
from safedpa.safety.barriers.cache import BarrierValueCache
from safedpa.safety.barriers.equation import AbstractEquationBarrier
from safedpa.safety.barriers.rollout import RolloutBarrier
from safedpa.safety.barriers.stack import CompiledBarrierSet, make_barrier_set
from safedpa.safety.prediction.predictor import Prediction
from safedpa.safety.settings import FilterSettings
from safedpa.safety.solver.candidates import HeldSolution
from safedpa.safety.solver.constraints import ActionCandidate
from safedpa.safety.solver.qp import QuadraticProgram
from safedpa.safety.validation import InvalidInput, Plausible, checked_input
from safedpa.safety.verdict import OUTSIDE_LIMITS, Status, Verdict

__all__ = ["BELOW", "CORRECTED", "OPEN", "PASSED", "CompiledDecisions", "Found", "SearchResult"]

PASSED: Final = 0
"""The nominal action, clipped to its bounds, is feasible."""
CORRECTED: Final = 1
OPEN: Final = 2
"""No feasible action was found from the nominal one."""
BELOW: Final = 3
"""Some h is below 0."""
_MOST_ACTIONS: Final = 2
_MOST_STATES: Final = 64


class _Scene(NamedTuple):
    """What the search is prepared for."""

    parts: Any
    requested: dict[str, float] | None


class Found(NamedTuple):
    """One action and what is predicted for it."""

    kind: int
    action: tuple[float, ...]
    slack: float
    active: tuple[int, ...]
    """Rows that bind or are violated, the tightest first."""
    h_now: float
    h_next: float
    solver: str


class SearchResult(NamedTuple):
    """The result of a search after ``OPEN`` or ``BELOW``."""

    found: Found
    how: int
    """0: from another start, 1: from a sample, 2: among the least-violation actions; 3: least violation."""
    violated: tuple[int, ...] = ()
    uncontrollable: tuple[int, ...] = ()
    candidate: ActionCandidate | None = None

    @property
    def is_feasible(self) -> bool:
        """Whether the action satisfies every constraint."""
        return self.candidate is None or self.candidate.is_feasible


@final
class CompiledDecisions:
    """The compiled search of one filter; for one decision at a time."""

    def __init__(self, settings: FilterSettings, program: QuadraticProgram, prediction: Prediction) -> None:
        self._settings, self._program, self._prediction = settings, program, prediction
        self._search: Any = None
        self._step: Any = None
        self._possible = len(program.sides) <= _MOST_ACTIONS and (
            prediction.is_project_model or prediction.step_function is not None
        )
        self._scene: _Scene | None = None
        self._ranges: Any = None

    def accept(self, state: Plausible | None, nominal: Plausible, latent: Plausible | None) -> None:
        """Sets the ranges of inputs, outside which ``verdict`` declines; before the first decision."""
        self._ranges = state, nominal, latent

    def prepare(self, parts: Sequence[AbstractBarrier] | None, states: int) -> None:
        """Loads, and waits for the compiler, so that the first decision need not."""
        if not self._possible:
            return
        try:
            load_module()
        except NoKernelError as error:
            remark(str(error))
            self._possible = False
            return
        self._prediction.affine_networks()  # 3 ms of comparisons with NumPy now, rather than within a decision
        if parts:  # a filter that gets its barriers later is that of a robot that may be driving already
            self._prediction.wait_for_compiler()
        barriers = make_barrier_set(parts or ())
        if isinstance(barriers, CompiledBarrierSet) and states:
            with contextlib.suppress(Exception):  # what fails here is reported by the decision that needs it
                barriers.prepare(states)

    def verdict(
        self, tools: Any, state: Any, nominal: Any, latent: Any, parts: Any, epsilon: Any, time: Any, memory: Any
    ) -> Any:
        """The verdict on inputs of the usual kinds, if it is ``passed`` or ``corrected``; None: ask ``Decision``.

        ``tools`` is the ``FilterContext``. Raises what a barrier or the model raises.
        """
        prediction = self._prediction
        at_once = memory is None or prediction.has_nothing_in_flight(memory)
        if not self._possible or self._ranges is None or not at_once or not self._report_time(time):
            return None
        step = None if prediction.affine else prediction.compiled_step(0, len(self._program.sides))
        scene = self._scene
        if scene is None or parts is not scene.parts or step is not self._step or epsilon != scene.requested:
            scene = self._scene = self._scene_of(tools, parts, epsilon, step)
        needs_latent = tools.latent_range is not None and tools.latent_range.names
        if scene is None or (latent is None and needs_latent):
            return None
        free = prediction.nominal_latent if latent is None else latent
        known = prediction.affine_networks() if step is None else (None, 0.0, 0.0)
        if known is not None:
            return self._search.verdict(state, nominal, free, prediction.seconds, *known)
        place, free = checked_input("", state, tools.state_range), checked_input("", free, tools.latent_range)
        if isinstance(place, InvalidInput) or isinstance(free, InvalidInput):
            return None
        motion = prediction.affine_motion(place, free)
        if motion is None:
            return None
        return self._search.verdict(place, nominal, free, prediction.seconds, *motion.entries)

    def _report_time(self, time: Any) -> bool:
        """Passes the time [s] to the model; False where a ``Decision`` has to look at it."""
        if time is None:
            return not self._prediction.timed
        if type(time) is not float or not 0.0 <= time < inf:
            return False
        self._prediction.report_time(time)
        return True

    def _scene_of(self, tools: Any, parts: Any, epsilon: Any, step: Any) -> _Scene | None:
        """Prepares the search for these barriers and margins."""
        if not isinstance(parts, (tuple, AbstractBarrierSet)) or not (epsilon is None or type(epsilon) is dict):
            return None  # a list may change from call to call
        entries = len(tools.state_range.names) if tools.state_range is not None else 0
        if not entries or not tools.settings.enabled:
            return None
        barriers = tools.barrier_sets.get(parts, entries)
        if not barriers.names:
            return None
        margins, margin = tools.margins.resolve(barriers, {} if epsilon is None else epsilon)
        rows = self._rows_of(barriers, entries)
        if rows is None or not self._ready(step, rows):
            return None
        self._search.scene(rows, margins, barriers.at_once, barriers.names, margin, tools.margins.remark)
        return _Scene(parts, None if epsilon is None else dict(epsilon))

    def _rows_of(self, barriers: AbstractBarrierSet, states: int) -> Any:
        """The evaluator of barriers that do not look at where the state came from; else None."""
        if not isinstance(barriers, (CachingBarrierSet, CompiledBarrierSet)):
            return None
        rows = barriers.scalar_rows(states)
        return rows.barriers if isinstance(rows, BarrierValueCache) else rows

    def _rollout_of(self, barriers: AbstractBarrierSet, state: tuple[float, ...]) -> Any:
        """A compiled rollout that is the only barrier, after it was compared with its functions; else None."""
        part = barriers[0] if len(barriers) == 1 else None
        if not isinstance(part, RolloutBarrier):
            return None
        part.starting_at(np.array(state))  # compares
        return part.compiled_rows(len(state), len(self._program.sides), self._prediction.seconds)

    def decide(
        self,
        barriers: AbstractBarrierSet,
        nominal: tuple[float, ...],
        latent: tuple[float, ...] | None,
        states: int,
        start: tuple[float, ...],
        epsilon: Sequence[float],
        least: float = nan,
    ) -> Found | None:
        """The nominal action, or the nearest feasible one; None: Python has to decide.

        ``start`` (cases * states,) is where an action takes effect, one state for each delay. ``least`` is the smallest
        h at the measured state, if that is another one.
        """
        if not self._possible:
            return None
        self._scene = None
        rows = self._rows_of(barriers, states)
        if rows is None and isnan(least):
            rows = self._rollout_of(barriers, start)
        prediction = self._prediction
        motion = self._motion(start, latent) if prediction.affine else None
        step = prediction.compiled_step(states, len(nominal)) if motion is None else None
        if rows is None or (motion is None and step is None) or not self._ready(step, rows):
            return None
        free = prediction.nominal_latent if latent is None else latent
        known = (None, 0.0, 0.0) if motion is None else motion
        found = self._search.decide(
            rows, start, nominal, free, prediction.seconds, epsilon, barriers.at_once, *known, least
        )
        return None if found is None else Found(*found)

    def _motion(self, start: tuple[float, ...], latent: tuple[float, ...] | None) -> Any:
        """f and g at a state, or the compiled networks that know them, with the periods; None: neither."""
        networks, physics = self._prediction.affine_networks(), self._prediction.physics
        if networks is not None and physics is not None:
            # Several delays have several states; wrong sizes are left to the general path, which names them.
            latents = len(physics.latent_names) if latent is None else len(latent)
            if len(start) == len(physics.system.state_names) and latents == len(physics.latent_names):
                return networks
        motion = self._prediction.affine_motion(start, latent)
        return None if motion is None else motion.entries

    def search(self, backup: tuple[float, ...]) -> SearchResult | None:
        """What to do after ``OPEN`` or ``BELOW``; None: Python has to decide."""
        found = self._search.search(backup)
        if found is None:
            return None
        answer, how, *more = found
        if not more:
            return SearchResult(Found(*answer), how)
        violated, uncontrollable, candidate = more
        return SearchResult(Found(*answer), how, violated, uncontrollable, ActionCandidate(*candidate))

    def reused(self, held: HeldSolution, seconds: float) -> SearchResult | None:
        """The action of the last search of this robot, if it is still as good; as ``reuse_if_no_worse``."""
        evaluator = _Evaluator(self._search)
        if held.reuse_if_no_worse(evaluator, self._program.sides, seconds) is None:
            return None
        return evaluator.last

    def why_not(self, barriers: AbstractBarrierSet, states: int) -> str:
        """Why Python decides about these barriers at states of so many entries; empty: C does. May compile."""
        reason = why_not_compiled() or self._why_not_model(states)
        if reason or self._rows_of(barriers, states) is not None:
            return reason
        rollouts = [part for part in barriers if isinstance(part, RolloutBarrier)]
        if not rollouts:
            others = [name for part in barriers if not isinstance(part, AbstractEquationBarrier) for name in part.names]
            return f"{', '.join(others[:4])}: its h is a function, no AbstractEquationBarrier"
        return "a RolloutBarrier is next to other barriers" if len(barriers) > 1 else rollouts[0].not_compiled

    def _why_not_model(self, states: int) -> str:
        prediction, actions = self._prediction, len(self._program.sides)
        if actions > _MOST_ACTIONS:
            return f"it has {actions} actions, and C decides about one or two"
        if not prediction.is_project_model and prediction.step_function is None:
            return "the model is a function without the parameter 'operations'"
        if prediction.has_actuator_memory:
            return "the model's actuators have memory"
        prediction.wait_for_compiler()
        if not prediction.affine and prediction.compiled_step(states, actions) is None:
            return "the model's equations cannot be recorded, or have a function that C does not have"
        return ""

    def h_now(self) -> list[float]:
        """h (rows,) at the state of the decision."""
        found: list[float] = self._search.h_now()
        return found

    def _ready(self, step: Any, rows: Any) -> bool:
        """Makes the search at the first decision, and again for another step."""
        if self._search is None or step is not self._step:
            try:
                module = load_module()
            except NoKernelError as error:
                remark(str(error))
                self._possible = False
                return False
            low, high, width = zip(*self._program.sides, strict=True)
            rounds, affine = self._settings.relinearisations + 1, self._prediction.affine
            weights = self._program.weights.tolist()
            self._search = module.Search(low, high, width, weights, self._settings.eta, rounds, affine, step)
            if self._ranges is not None:
                ranges = [None if one is None else (one.low_floats, one.high_floats) for one in self._ranges]
                kinds = Verdict, Status.passed, Status.corrected, OUTSIDE_LIMITS
                self._search.prepare(*kinds, np.ndarray, np.frombuffer, *ranges)
            self._step, self._rows = step, (module.Rows, module.Rollout)
        return type(rows) in self._rows


@final
class _Evaluator:
    """What a held solution needs of constraints."""

    def __init__(self, search: Any) -> None:
        self._search = search
        self.last: SearchResult | None = None

    def evaluate(self, action: Sequence[float]) -> ActionCandidate:
        found = self._search.evaluate(action)
        if found is None:  # odd numbers: no candidate is as good as it was
            return ActionCandidate(action, [], [float("-inf")], [], [])
        answer, violated, candidate = found
        self.last = SearchResult(Found(*answer), 3, violated, (), ActionCandidate(*candidate))
        assert self.last.candidate is not None
        return self.last.candidate
