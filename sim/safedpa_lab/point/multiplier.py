"""The Lagrange multiplier of PPO-Lagrangian and TRPO-Lagrangian: three ways in which it follows the cost.

With J what an episode costs of the policy as it is now, d the limit, after every rollout

    integral   w <- max(0, w + rate (J - d))
    waiting    the same, once an episode gains more than ``STANDING_STILL``
    pid        w <- max(0, K_P s + I + K_D max(0, s - s[last])),  I <- max(0, I + rate (J - d)),
               s <- 0.9 s + 0.1 (J - d)

each cut at ``cap`` where there is one. Before anything is learned the cost is high for long: the integral winds up to
many times what it would settle at, and the robots learn to be stationary. Who waits does not learn the weight while
there is nothing to weigh the cost against. Source: Ray, Achiam, Amodei, Benchmarking Safe Exploration in Deep
Reinforcement Learning, 2019 (integral); Stooke, Achiam, Abbeel, Responsive Safety in Reinforcement Learning by PID
Lagrangian Methods, ICML 2020.
"""

from __future__ import annotations

from collections.abc import Callable
from math import inf
from typing import Final, final

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from safedpa_lab.point.plan import Plan
from safedpa_lab.point.vector_environment import PointEnvironment

__all__ = ["STANDING_STILL", "Multiplier"]

STANDING_STILL: Final = 1.0
"""Return of an episode: who is stationary gains nothing; one goal is worth more than this."""
_RATE: Final = 0.002
_SMOOTH: Final = 0.9
_PROPORTIONAL, _DERIVATIVE = 0.02, 0.02


@final
class Multiplier(BaseCallback):
    """Sets the environment's ``weight`` by the plan's ``limit``, ``cap`` and ``multiplier``."""

    def __init__(self, environment: PointEnvironment, plan: Plan, rate: float = _RATE) -> None:
        super().__init__()
        self._environment, self._limit, self._rate = environment, plan.limit, rate
        self._largest = inf if plan.cap is None else plan.cap
        ways: dict[str, Callable[[float], float]] = {
            "integral": self._integrated,
            "waiting": self._waited,
            "pid": self._controlled,
        }
        self._way = ways[plan.multiplier]
        self._integral = self._smooth = 0.0

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        self._environment.begin()

    def _on_rollout_end(self) -> None:
        environment = self._environment
        environment.weight = min(self._way(environment.episode_cost - self._limit), self._largest)

    def _integrated(self, over: float) -> float:
        self._integral = min(max(0.0, self._integral + self._rate * over), self._largest)
        return self._integral

    def _waited(self, over: float) -> float:
        returns = self._environment.returns
        learns = bool(returns) and float(np.mean(returns)) > STANDING_STILL
        return self._integrated(over) if learns else self._integral

    def _controlled(self, over: float) -> float:
        before, self._smooth = self._smooth, _SMOOTH * self._smooth + (1.0 - _SMOOTH) * over
        rising = max(0.0, self._smooth - before)
        return max(0.0, _PROPORTIONAL * self._smooth + self._integrated(over) + _DERIVATIVE * rising)
