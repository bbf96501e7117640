"""Residual inputs: the constant rate, window by window, that a model would need to agree with the measurements."""

from __future__ import annotations

from collections.abc import Sequence
from typing import final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.diagnosis.fit.multiple_shooting import Shooting
from safedpa.diagnosis.fit.trial import EffectTrial, with_effect_at
from safedpa.effects.effect import Context, Named, RateEffect, Stage
from safedpa.effects.parameter import Parameter

# Step of the difference quotient: small against any real disturbance, far above rounding.
_STEP = 0.01


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
    """Returns the constant rates (windows, states), in state units per second, by least squares in each window."""
    model = trial.fit.model
    now = shooting.residuals([model])[0]
    columns = []
    for state in states:
        disturbed = with_effect_at(model, _ConstantRate(state, model.system.name), {"amount": _STEP})
        columns.append((shooting.residuals([disturbed])[0] - now) / _STEP)
    reduced = shooting.eliminated(np.stack([now, *columns], axis=-1), trial.fit.scale)
    residual, slopes = reduced[..., 0], reduced[..., 1:]
    # The ridge covers windows in which a rate does not show, for example one with a single counted row.
    gram = np.einsum("wip,wiq->wpq", slopes, slopes) + 1e-9 * np.eye(len(states))
    right = np.einsum("wip,wi->wp", slopes, residual)
    return -np.asarray(np.linalg.solve(gram, right[..., None])[..., 0])
