"""What a towed load does beside holding the car back: it swings behind the car and pulls at its rear to the side.

The library's ``towed_load`` is in line with the car. A real one follows on a drawbar; its angle theta to the car obeys,
with the hitch h behind the tracked point and the load's centre l behind the hitch, rolling or sliding without slip,

    d(theta)/dt = -(speed sin(theta) + h yaw_rate cos(theta)) / l - yaw_rate,   |theta| <= stop

so it pulls with mass_ratio (deceleration sign(speed) + d(speed)/dt) per mass of the car along the drawbar. The part to
the side, s = -pull sin(theta), is held by the tyres, which then slip: the car drifts and turns by

    sideways speed = slip s (|speed| + 0.3 m/s),   yaw rate -= lever slip s (|speed| + 0.3 m/s)

Nobody has measured h, l, stop, slip and lever of a load that has yet to come: each car has its own, drawn from wide
ranges, so that the history encoder learns to see them. Source: the kinematic trailer, Rajamani, Vehicle Dynamics and
Control, 2nd ed., and tyres of constant cornering stiffness; all ranges are assumed.
"""

from __future__ import annotations

from typing import final

import torch

from safedpa_sim.training.simulator import BatchedCars

__all__ = ["Drawbars"]

Tensor = torch.Tensor

_RANGES = {
    "hitch": (0.03, 0.15),
    "length": (0.2, 0.6),
    "stop": (0.6, 1.2),
    "slip": (0.006, 0.04),
    "lever": (2.5, 5.5),
}
"""h, l [m], stop [rad], slip [s2/m], lever [1/m]."""
_SLOWEST = 0.3
"""m/s added to the speed in the slip."""
_REST = 0.03
"""m/s; below it the pull fades."""
_LOAD = ("towed_load.mass_ratio", "towed_load.deceleration")


@final
class Drawbars:
    """The loads of ``count`` cars, straight behind them at the start; nothing where e holds no towed load."""

    def __init__(self, cars: BatchedCars, count: int, generator: torch.Generator) -> None:
        paths = [entry.path for entry in cars.entries]
        self._columns = tuple(paths.index(path) for path in _LOAD) if set(_LOAD) <= set(paths) else ()
        self._cars, self._generator = cars, generator
        self._drawn = self._draw(count)
        self._angle = torch.zeros(count, device=cars.device)
        self._last = torch.zeros(count, device=cars.device)
        """Change of speed in the last period."""

    def environment(self, environment: Tensor) -> Tensor:
        """e with the pull that is left in line with the car: deceleration cos(theta)."""
        if not self._columns:
            return environment
        seen = environment.clone()
        seen[:, self._columns[1]] *= torch.cos(self._angle)
        return seen

    def pulled(self, state: Tensor, following: Tensor, environment: Tensor) -> Tensor:
        """The next states (count, 4) with the pull to the side; the loads swing on."""
        if not self._columns:
            return following
        period, drawn = self._cars.model.period, self._drawn
        ratio, deceleration = (environment[:, column] for column in self._columns)
        speed = 0.5 * (state[:, 3] + following[:, 3])
        rate = (following[:, 2] - state[:, 2]) / period
        pull = ratio * (deceleration * torch.tanh(speed / _REST) + self._last / period)
        aside = -pull * torch.sin(self._angle) * drawn["slip"] * (speed.abs() + _SLOWEST) * period
        turn = -drawn["lever"] * aside
        yaw = state[:, 2] + 0.5 * (rate * period + turn)
        swing = (speed * torch.sin(self._angle) + drawn["hitch"] * rate * torch.cos(self._angle)) / drawn["length"]
        angle = self._angle - period * (swing + rate)
        self._angle = torch.maximum(torch.minimum(angle, drawn["stop"]), -drawn["stop"])
        self._last = following[:, 3] - state[:, 3]
        change = torch.stack((-torch.sin(yaw) * aside, torch.cos(yaw) * aside, turn, torch.zeros_like(turn)), 1)
        along = 0.5 * turn * speed * period
        change[:, 0] -= torch.sin(yaw) * along
        change[:, 1] += torch.cos(yaw) * along
        return following + change

    def renew(self, which: Tensor) -> None:
        """Other loads for the cars marked (count,): hitched straight behind them."""
        fresh = self._draw(len(which))
        self._drawn = {name: torch.where(which, fresh[name], values) for name, values in self._drawn.items()}
        self._angle = torch.where(which, torch.zeros_like(self._angle), self._angle)

    def _draw(self, count: int) -> dict[str, Tensor]:
        def uniform(low: float, high: float) -> Tensor:
            return low + (high - low) * torch.rand(count, generator=self._generator, device=self._cars.device)

        return {name: uniform(*pair) for name, pair in _RANGES.items()}
