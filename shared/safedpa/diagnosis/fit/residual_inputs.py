"""Pushes: the constant rate, window by window, that a model would need to agree with the measurements."""

from __future__ import annotations

from collections.abc import Sequence
from typing import final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.diagnosis.fit.multiple_shooting import Shooting
from safedpa.diagnosis.fit.trial import EffectTrial, with_effect_at
from safedpa.effects.effect import Context, Named, RateEffect, Stage
from safedpa.effects.parameter import Parameter

__all__ = ["residual_inputs"]

_SIZE = 0.01


@final
class _ConstantRate(RateEffect):
    """d(state)/dt += amount."""

    name = "push"
    robot = ""
    stage = Stage.MOTION
    equation = "d(state)/dt += amount"
    parameters = (Parameter("amount", "1/s", -1e6, 1e6, 1.0),)
    signature = "anything"
    source = "a disturbance that is constant over a window"

    def __init__(self, state: str, robot: str) -> None:
        self.state = state
        self.robot = robot  # type: ignore[misc]

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:
        del context
        return {**rates, self.state: rates[self.state] + parameters["amount"]}


def residual_inputs(trial: EffectTrial, shooting: Shooting, states: Sequence[str]) -> FloatArray:
    """Least squares of the reduced residual on constant rates: (windows, states), in units of the state per second."""
    model = trial.fit.model
    now = shooting.residuals([model])[0]
    columns = []
    for state in states:
        pushed = with_effect_at(model, _ConstantRate(state, model.system.name), {"amount": _SIZE})
        columns.append((shooting.residuals([pushed])[0] - now) / _SIZE)
    reduced = shooting.eliminated(np.stack([now, *columns], axis=-1), trial.fit.scale)
    residual, slopes = reduced[..., 0], reduced[..., 1:]
    gram = np.einsum("wip,wiq->wpq", slopes, slopes) + 1e-9 * np.eye(len(states))
    right = np.einsum("wip,wi->wp", slopes, residual)
    return -np.asarray(np.linalg.solve(gram, right[..., None])[..., 0])
