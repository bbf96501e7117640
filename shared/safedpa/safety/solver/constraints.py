"""The CBF constraints at one state: evaluated for an action, and linearised about one, in Python floats.

No threshold is absolute. What is small is measured against each barrier's


    scale_i = max(|h_i(x)|, epsilon_i, what the actions can change in h_i(x+))

so that no verdict depends on the unit in which h, a state or an action is expressed.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, isfinite
from typing import Any, Final, final

from safedpa.errors import InputError
from safedpa.safety.barriers.base import AbstractBarrierSet
from safedpa.safety.errors import NotFiniteError
from safedpa.safety.prediction.dead_time import EffectStart, InFlightCommands, MultiStepBarriers
from safedpa.safety.prediction.predictor import AffineMotion, Prediction
from safedpa.safety.solver.linearization import Linearization
from safedpa.safety.solver.qp_scaling import Side

__all__ = ["NO_INFLUENCE", "ROUNDING", "ActionCandidate", "Constraints", "Plain"]

Plain = Sequence[float]

NO_INFLUENCE: Final = 1e-9
"""A column of g that over the action's whole range changes no state entry by more than this share of the entry, or of
its motion, is rounding error: the actuator is saturated."""

_TINY: Final = 1e-300
"""Scale of a barrier with h = 0, no margin and no influence of any action; it only avoids a division by zero."""

_LARGEST: Final = 1.7976931348623157e308
"""Largest finite float, reported in place of an infinite violation: every value of a verdict is finite."""

ROUNDING: Final = 1e-10
"""Share of a barrier's scale by which its constraint may be violated: rounding errors of h and of the model."""


@final
class ActionCandidate:
    """An action (actions,) with its predicted state, h and residuals."""

    def __init__(
        self,
        action: Plain,
        next_state: Plain,
        h_next: list[float],
        residual: list[float],
        violated: list[int],
    ) -> None:
        self.action, self.next_state, self.h_next = action, next_state, h_next
        self.residual = residual
        """(m,) h_i(x+) - ((1 - eta) h_i(x) + epsilon_i)."""
        self.violated_rows = violated
        """Rows whose constraint is violated by more than rounding."""
        self.min_h_next: float = _smallest(h_next)
        """Smallest h_i(x+)."""
        self.is_finite: bool = self.min_h_next > -inf
        """False if model or barrier return a value that is not finite: then every h is -infinity."""
        # h >= 0 is required as well: with h_i(x) < 0 a constraint may allow a next state that is still unsafe.
        self.is_feasible: bool = not violated and self.min_h_next >= 0.0
        """Whether every constraint holds, and every h_i(x+) >= 0."""

    @property
    def violation(self) -> float:
        """The largest slack that this action needs, in the unit of that row's h."""
        worst = 0.0
        for row in self.violated_rows:
            missing = -self.residual[row]
            worst = missing if missing > worst else worst
        return worst if worst < _LARGEST else _LARGEST


@final
class Constraints:
    """h_i(x[t+1]) >= (1 - eta) h_i(x[t]) + epsilon_i for every barrier i, at one state and latent.

    eta is 1 for barriers that may be used up ``at_once``. ``sides`` (actions,) are lowest value, highest value and
    range of each action.

    Raises InputError if a barrier or the model returns a wrong shape or a value that is not finite.
    """

    def __init__(
        self,
        barriers: AbstractBarrierSet,
        prediction: Prediction,
        state: tuple[float, ...],
        latent: tuple[float, ...] | None,
        memory: Any,
        eta: float,
        epsilon: Plain,
        sides: Sequence[Side],
    ) -> None:
        self.barriers, self._prediction = barriers, prediction
        # Barriers that look between two ticks need the measured state, not the predicted one at which an action takes
        # effect.
        plain = barriers.starting_at(state).scalar_rows(len(state))
        self._plain: Any = plain
        self._one_state: Any = plain
        """The same barriers at one state; ``_plain`` may evaluate several at once."""
        self._state, self._latent, self._sides = state, latent, sides
        self._memory = memory.memory if isinstance(memory, InFlightCommands) else memory
        self._widths: list[float] = [width for _, _, width in sides]
        h_now: list[float] = plain.h_floats(state)
        self.h_now = h_now
        _require_finite("h at the state", h_now)
        self.min_h_now: float = _smallest(h_now)
        """Smallest h_i at the state."""
        self.min_h_in_flight: float = inf
        """Smallest h_i before an action takes effect, which no action can change; infinity: no dead time."""
        # With dead time the constraint is imposed at the predicted state where this action takes effect: before that no
        # action can change anything, and a constraint would be infeasible or trivially satisfied.
        self._effect = effect = prediction.effect_start(state, latent, memory)
        if effect is not None:
            # A faster channel acts before the slowest one, so every state from its effect on is constrained; and so is
            # the state under every delay that is not ruled out.
            if (count := sum([case.steps for case in effect.cases])) > 1:
                self._plain = plain = MultiStepBarriers(plain, count, len(state))
            self._state = tuple([entry for case in effect.cases for entry in case.state])
            h_now = plain.h_floats(self._state)
            epsilon = self._margins_of_cases(effect.cases, epsilon, eta)
            # Then only the start state differs; prediction from it needs no further delay model.
            if effect.at_once and not prediction.has_actuator_memory:
                self._effect, self._memory = None, effect.memory
            _require_finite("h where the action takes effect", h_now)
        self.h_at_effect = h_now
        """(rows,) h where the action takes effect; one block of rows for each state that is constrained."""
        self._motion: AffineMotion | None = prediction.affine_motion(self._state, latent) if prediction.affine else None
        self.affine: bool = prediction.affine
        """Whether the predicted state is affine in the action; then no actuator saturates."""
        self.saturated: bool = False
        """Whether a linearisation was computed where an actuator saturates."""
        self._last_g: list[list[float]] | None = None
        self.budget: Any = None
        """The ``DecisionBudget`` of this decision; None: unlimited."""
        self.margins = epsilon
        """(rows,) epsilon_i, grown by what is in flight."""
        self._set_right_hand_side(h_now, epsilon, 1.0 - eta)

    @property
    def start(self) -> tuple[float, ...] | None:
        """(cases * states,) where the constraints start, one state for each delay; None: the action acts late."""
        if self._effect is None:
            return self._state
        late = any(case.waiting_periods > 0 or case.steps != 1 for case in self._effect.cases)
        return None if late or self._prediction.has_actuator_memory else self._state

    def _margins_of_cases(self, cases: Sequence[EffectStart], epsilon: Plain, eta: float) -> list[float]:
        """(rows,) epsilon_i + eta min(n epsilon_i, travel_i), where n periods of commands act before the constraint.

        A margin covers the error e of h over one step. Over n steps the errors add up to n e where each is e at most,
        and to no more than h moves in that time: at rest there is none. The constraint compares h after n + 1 steps
        with (1 - eta) h after n, both predicted, so that its error is (n + 1) e - (1 - eta) n e = e + eta n e. A dead
        time of the model's own is not counted: its margin was calibrated over the whole prediction.
        """
        grown: list[float] = []
        for case in cases:
            travel = self._travel_in_flight(case.path)
            for _ in range(case.steps):
                for row in range(len(travel)):
                    margin, most = epsilon[row], travel[row]
                    error = case.queued_periods * margin
                    grown.append(margin + eta * (error if error < most else most))
        return grown

    def _travel_in_flight(self, path: Sequence[Plain]) -> list[float]:
        """(m,) by how much each h moves, up and down, along the states ``path`` that no action can change."""
        before, travel = self.h_now, [0.0] * len(self.h_now)
        for passed in path:
            h_in_flight: list[float] = self._one_state.h_floats(passed)
            _require_finite("h while commands are in flight", h_in_flight)
            self.min_h_in_flight = min(self.min_h_in_flight, *h_in_flight)
            for row in range(len(travel)):
                travel[row] += abs(h_in_flight[row] - before[row])
            before = h_in_flight
        return travel

    def _set_right_hand_side(self, h_now: list[float], epsilon: Plain, share: float) -> None:
        """Sets rhs_i = share h_i + epsilon_i (share 0 for ``at_once``), and the scales of the constraints."""
        at_once = self.barriers.at_once
        if len(epsilon) != len(h_now):
            raise ValueError(f"{len(epsilon)} margins for {len(h_now)} barriers")
        rhs: list[float] = []
        scales: list[float] = []
        for index in range(len(h_now)):
            margin: float = epsilon[index]
            # ``at_once``: the whole of h may be used in one step, down to the margin.
            rhs.append(margin if at_once[index % len(at_once)] else share * h_now[index] + margin)
            size = abs(h_now[index])
            # The scale is never 0, so that residual / scale exists; comparisons only, since max() is a slow call when
            # compiled.
            scales.append(size if size > margin else margin if margin > _TINY else _TINY)
        self.rhs = rhs
        self.base_scales = scales.copy()
        """(m,) max(|h_i(x)|, epsilon_i)."""
        self.scales = scales
        """(m,) in the unit of each h; grows by what the actions can change, as soon as a linearisation shows it."""

    def evaluate(self, action: Plain) -> ActionCandidate:
        """Predicts the next state and h under ``action`` (actions,). Raises OutOfBudgetError beyond the budget."""
        if self.budget is None:
            return self._evaluate(action)
        self.budget.spend()
        candidate = self._evaluate(action)
        self.budget.candidates.append(candidate)
        return candidate

    def _evaluate(self, action: Plain) -> ActionCandidate:
        next_state, rhs, scales = self._predict(action), self.rhs, self.scales
        if not _is_finite(next_state):
            return self._infeasible_candidate(action, next_state)
        h_next: list[float] = self._plain.h_floats(next_state)
        if len(h_next) != len(rhs):
            raise ValueError(f"{len(h_next)} values of h, wanted {len(rhs)}")
        residual: list[float] = []
        violated: list[int] = []
        total = 0.0
        for index in range(len(rhs)):
            slack = h_next[index] - rhs[index]
            total += slack
            residual.append(slack)
            # Two comparisons: most residuals are positive, and then no product is computed.
            if slack < 0.0 and slack < -ROUNDING * scales[index]:
                violated.append(index)
        # One sum finds NaN and infinity in most cases; h itself is scanned only if the sum is not finite.
        if total - total != 0.0 and not _is_finite(h_next):
            return self._infeasible_candidate(action, next_state)
        return ActionCandidate(action, next_state, h_next, residual, violated)

    def _infeasible_candidate(self, action: Plain, next_state: Plain) -> ActionCandidate:
        """The candidate of an action for which model or barrier return a value that is not finite."""
        # -infinity in every row: a candidate without a prediction must never win a comparison.
        lowest = [-inf] * len(self.rhs)
        return ActionCandidate(action, next_state, lowest, lowest, list(range(len(lowest))))

    def linearize(self, about: ActionCandidate) -> Linearization:
        """The constraints linearised about ``about``. Raises OutOfBudgetError beyond the budget."""
        if self.budget is not None:
            self.budget.spend()
        # An affine model has the same g everywhere: one computation serves all iterations of the SQP.
        if self._last_g is None or not self._prediction.affine:
            self._last_g = self._control_matrix(about)
        return Linearization(self._plain, self._last_g, about.next_state, self._widths, self.scales)

    def min_scaled_residual(self, found: ActionCandidate) -> float:
        """Smallest residual, each as a share of its barrier's scale."""
        residual, scales = found.residual, self.scales
        smallest = residual[0] / scales[0]
        for row in range(1, len(residual)):
            value = residual[row]
            # Multiplied instead of divided: one division for each new minimum only.
            if value < smallest * scales[row]:
                smallest = value / scales[row]
        return smallest

    def active_names(self, found: ActionCandidate, limit: float) -> tuple[str, ...]:
        """Names of the barriers whose residual is at most ``limit`` of their scale, the tightest first."""
        near: list[tuple[float, int]] = []
        scales = self.scales
        for row in range(len(found.residual)):
            value = found.residual[row]
            if value <= limit * scales[row]:
                near.append((value / scales[row], row))
        if not near:
            return ()
        near.sort()
        names = self.barriers.names
        # Several rows may belong to one barrier; dict.fromkeys removes repeated names and keeps the order.
        return tuple(dict.fromkeys([names[row % len(names)] for _, row in near]))

    def _control_matrix(self, about: ActionCandidate) -> list[list[float]]:
        """g (states, actions) about a candidate."""
        g: list[list[float]]
        if self._motion is not None:
            g = self._motion.control_matrix()
        elif self._effect is not None:
            g = self._prediction.control_matrix_at_effect(self._effect, about.action, self._latent)
        else:
            g = self._prediction.control_matrix_floats(self._state, about.action, self._latent, self._memory)
        for row in g:
            if not _is_finite(row):
                raise NotFiniteError("g of the model: got NaN or infinity, wanted finite numbers")
        return g if self._prediction.affine else self._replace_saturated_columns(g, about)

    def _predict(self, action: Plain) -> list[float]:
        found: list[float]
        if self._motion is not None:
            found = self._motion.next_state(action)
        elif self._effect is not None:
            found = self._prediction.rollout(self._effect, action, self._latent)
        else:
            found = self._prediction.next_state_floats(self._state, action, self._latent, self._memory)
        return found

    def _replace_saturated_columns(self, g: list[list[float]], about: ActionCandidate) -> list[list[float]]:
        """Replaces each column of g that vanishes because the actuator saturates at ``about`` by a chord.

        A zero column would say that this action has no influence, although its other values have. The chord leads to
        the bound that is further away, unless an earlier linearisation knows the derivative.
        """
        for index in range(len(about.action)):
            if self._is_saturated(g, index, about.next_state):
                self.saturated = True
                last = self._last_g
                # An earlier derivative is exact at some action, a chord nowhere.
                column = self._chord(about, index) if last is None else [row[index] for row in last]
                # No finite value at the bound either: keep the zero column, since NaN would spoil the whole program.
                if not _is_finite(column):
                    continue
                g = [[*row[:index], entry, *row[index + 1 :]] for row, entry in zip(g, column, strict=True)]
        return g

    def _is_saturated(self, g: list[list[float]], column: int, reached: Plain) -> bool:
        width = self._widths[column]
        for row in range(len(g)):
            entry: float = reached[row]
            motion = abs(entry - self._state[row])
            size = abs(entry)
            noise = NO_INFLUENCE * (motion if motion > size else size)
            # Written as "not <=", so that NaN counts as influence and is found by the check for finite values.
            if not abs(g[row][column]) * width <= noise:
                return False
        return True

    def _chord(self, about: ActionCandidate, index: int) -> list[float]:
        value, (low, high, _) = about.action[index], self._sides[index]
        end = low if value - low > high - value else high
        other = (*about.action[:index], end, *about.action[index + 1 :])
        reached = zip(self._predict(other), about.next_state, strict=True)
        return [(there - here) / (end - value) for there, here in reached]


def _smallest(numbers: list[float]) -> float:
    smallest = numbers[0]
    for value in numbers:
        smallest = value if value < smallest else smallest
    return smallest


def _require_finite(what: str, numbers: list[float]) -> None:
    if not _is_finite(numbers):
        raise InputError(f"{what}: got NaN or infinity, wanted finite numbers")


def _is_finite(numbers: list[float]) -> bool:
    total = 0.0
    for value in numbers:
        total += value
    # The sum of finite numbers may overflow, so a sum that is not finite is only a hint.
    return total - total == 0.0 or all(map(isfinite, numbers))
