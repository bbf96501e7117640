"""The interface of a model, as filter, adaptation, comparison and simulation use it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

from safedpa.systems import System

Array = Any
"""A NumPy array or a torch tensor; results have the kind of the arguments."""


class AbstractDynamics(ABC):
    """A discrete-time model x[t+1] = step(x[t], a[t]); the filter uses its tangent f(x, z) + g(x, z) a.

    Shapes: state (..., states), action (..., actions), latent (..., latents); leading axes broadcast, so that one
    action or one latent may serve a whole batch of states. NumPy vectors take the fast path for one robot; batches are
    NumPy arrays or torch tensors.
    """

    system: System
    period: float
    """s between two steps, unless a call passes another."""
    latent_names: tuple[str, ...]
    """Names of the entries of the latent z, as paths such as ``base.speed_gain``; empty if there are none."""

    @abstractmethod
    def initial_memory(self, action: Array, latent: Array | None = None) -> Any:
        """Returns the actuators' memory after ``action`` (..., actions) has been held for a long time."""

    @abstractmethod
    def advance(
        self,
        state: Array,
        action: Array,
        memory: Any,
        latent: Array | None = None,
        *,
        period: float | None = None,
        time: float = 0.0,
    ) -> tuple[Array, Any]:
        """Returns state and memory after ``period`` seconds under a held action.

        ``time`` [s] counts from the start of the run; a model with a ``RunClock`` adds the clock's seconds.
        """

    def rollout_held(
        self, state: Array, action: Array, memory: Any, latent: Array | None, steps: int, *, period: float
    ) -> tuple[list[list[float]], Any]:
        """Returns one robot's states (steps, states) under a held action, and the memory after the first period."""
        rows, after_one = [], None
        for index in range(steps):
            state, memory = self.advance(state, action, memory, latent, period=period)
            after_one = memory if index == 0 else after_one  # what follows is a forecast
            rows.append(state.tolist())
        return rows, after_one

    def step(self, state: Array, action: Array, latent: Array | None = None) -> Array:
        """Returns x[t+1] (..., states) for actuators that have settled at ``action`` (..., actions)."""
        # settled: a single step has no history from which a lag or delay could know what was sent before
        return self.advance(state, action, self.initial_memory(action, latent), latent)[0]

    @abstractmethod
    def affine(
        self,
        state: Array,
        latent: Array | None = None,
        *,
        around: Array | None = None,
        memory: Any = None,
        time: float = 0.0,
    ) -> tuple[Array, Array]:
        """Returns (f, g) with x[t+1] = f + g a, shapes (..., states) and (..., states, actions).

        Exact if the model is affine in the action; else the tangent at the action ``around`` (..., actions), by
        default the middle of the actuator bounds. ``memory`` as from ``advance``; by default settled at ``around``.
        ``time`` [s] counts from the start of the run.
        """

    def control_matrix(self, state: Array, latent: Array | None, around: Array, memory: Any) -> Array:
        """Returns g (..., states, actions) of ``affine`` at the action ``around``, for callers that need no f."""
        return self.affine(state, latent, around=around, memory=memory)[1]


@dataclass
class RunClock:
    """The time [s] since the start of the run at which a model is evaluated, for callers that run tick by tick.

    The argument ``time`` of a call counts from there. A service that uses one model for several robots sets the clock
    before each call.
    """

    seconds: float = 0.0
