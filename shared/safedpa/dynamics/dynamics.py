"""The one seam through which filter, adaptation, comparison and simulation see a model."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

from safedpa.systems import System

__all__ = ["AbstractDynamics", "Array", "RunClock"]

Array = Any
"""A numpy array or a torch tensor; what comes out is of the kind that went in."""


class AbstractDynamics(ABC):
    """A discrete-time model x[t+1] = step(x[t], a[t]), seen by the filter as f(x, z) + g(x, z) a.

    Shapes: state (..., states), action (..., actions), latent (..., latents); leading axes broadcast, so that one
    action or one latent may serve a whole batch of states. Numpy arrays without leading axes take the fast path for one
    robot; batches are numpy arrays or torch tensors.
    """

    system: System
    period: float
    """Seconds between two steps, unless a call says otherwise."""
    latent_names: tuple[str, ...]
    """What the entries of the latent z mean; empty when the model has none."""

    @abstractmethod
    def initial_memory(self, action: Array, latent: Array | None = None) -> Any:
        """What the actuators remember after ``action`` (..., actions) has been held for a long time."""

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
        """State and memory after ``period`` seconds under a held action.

        ``time`` [s] counts from the run's start, or from where a model with a clock was told that it is.
        """

    def held(
        self, state: Array, action: Array, memory: Any, latent: Array | None, steps: int, *, period: float
    ) -> tuple[list[list[float]], Any]:
        """States (steps, states) under one robot's action held, period by period, and the memory after the first."""
        rows, after_one = [], None
        for index in range(steps):
            state, memory = self.advance(state, action, memory, latent, period=period)
            after_one = memory if index == 0 else after_one
            rows.append(state.tolist())
        return rows, after_one

    def step(self, state: Array, action: Array, latent: Array | None = None) -> Array:
        """x[t+1] (..., states), for actuators that have settled at ``action`` (..., actions)."""
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
        """(f, g) with x[t+1] = f + g a, shapes (..., states) and (..., states, actions).

        Exact where the model is affine in the action; else the tangent at the action ``around`` (..., actions), by
        default the middle of the actuator bounds. ``memory`` as from ``advance``; by default settled at ``around``.
        ``time`` [s] counts from the run's start.
        """

    def slopes(self, state: Array, latent: Array | None, around: Array, memory: Any) -> Array:
        """g (..., states, actions) of ``affine`` about the action ``around``, for who needs no f."""
        return self.affine(state, latent, around=around, memory=memory)[1]


@dataclass
class RunClock:
    """At what time of its run a model is asked, for who asks it tick by tick: filter, estimator, policy.

    Seconds since the start of the run, 0 until someone says; what a call says as ``time`` counts from there.
    Who serves several robots with one model sets it again before each question.
    """

    seconds: float = 0.0
