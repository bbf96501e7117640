"""Robots whose own body is simulated in training: no model stands between the networks and what they shall know."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final

import torch

from safedpa.errors import InputError, did_you_mean

__all__ = ["Body", "body_of"]

Tensor = torch.Tensor
Body = Callable[[Tensor, Tensor, Tensor, Any], tuple[Tensor, Any]]
"""(state, action, environment, memory) to state and memory one period later; memory () where nothing is known of it."""

_POINT_PATHS: Final = (
    "constant_force.ax",
    "constant_force.ay",
    "viscous_drag.coefficient",
    "actuator_gain.gain",
)
"""What the point's body can be given; the model's drag is the body's own."""


def body_of(robot: str, paths: Sequence[str], usual: Sequence[float]) -> Body | None:
    """The body of a kind of robot in environments of those entries, or nothing where the model itself is simulated.

    ``usual`` holds the entries' values where nothing acts. Raises InputError for an entry that the body does not have.
    """
    if robot != "point":
        return None
    for path in paths:
        if path not in _POINT_PATHS:
            raise InputError(f"environment '{path}': {did_you_mean(path, _POINT_PATHS)}")
    return _point_body(list(paths), list(usual))


def _point_body(paths: list[str], usual: list[float]) -> Body:
    from safedpa_sim.point.body_steps import after_one_period

    def column(environment: Tensor, path: str, otherwise: float) -> Any:
        values = environment[:, paths.index(path)].double() if path in paths else environment.new_full((1,), otherwise)
        return values.expand(len(environment)).cpu().numpy()

    neutral = dict(zip(paths, usual, strict=True))

    def after(state: Tensor, action: Tensor, environment: Tensor, memory: Any) -> tuple[Tensor, Any]:
        import numpy as np

        wind = np.stack([column(environment, path, 0.0) for path in _POINT_PATHS[:2]], axis=1)
        drag = column(environment, _POINT_PATHS[2], 0.0) - neutral.get(_POINT_PATHS[2], 0.0)
        gain = column(environment, _POINT_PATHS[3], 1.0)
        sent = action.double().cpu().numpy()
        rate = sent[:, 1] if isinstance(memory, tuple) else memory
        following, rate = after_one_period(state.double().cpu().numpy(), sent, rate, wind, drag, gain)
        return torch.from_numpy(following).to(state), rate

    return after
