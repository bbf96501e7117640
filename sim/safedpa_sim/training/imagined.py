"""Drives of the tuned robot under loads and winds that it never met: named effects on top of what was learned.

Circles without load teach how the robot's own drive and steering behave, and nothing of loads. The simulator knows
loads and not this robot. Both together: the tuned networks move the robot, and the library's effects that the
configuration randomises act on it, by half a kick, a step of the networks, and half a kick:

    kick = step with effects(x, a) - step without(x, a),   x' = step without(x + kick / 2, a) + kick / 2

(Strang's splitting: of second order in the period.) The encoder is shown the rows of a robot that no effect acts on, so
that its latent tells where motor and steering stand, as it learned from the circles.
"""

from __future__ import annotations

from typing import Any, final

import torch

from safedpa.dynamics import PhysicsModel, Setting
from safedpa.dynamics.learned_base import LearnedBase
from safedpa.dynamics.settings import LATENT_PREFIX
from safedpa.networks import Weights
from safedpa_sim.training.drives import RandomDriver
from safedpa_sim.training.histories import Lived, history_rows, lived
from safedpa_sim.training.networks import AffineNetworks, HistoryNetwork
from safedpa_sim.training.simulator import BatchedCars

__all__ = ["ImaginedCars", "imagined_drives"]

Tensor = torch.Tensor


@final
class ImaginedCars:
    """Steps of the tuned robot with and without effects, for many robots with latents and environments that differ."""

    def __init__(self, cars: BatchedCars, weights: Weights) -> None:
        physics = cars.model
        base = LearnedBase(physics.base, weights)
        own = {path: Setting(value.value) for path, value in physics.settings.items() if path.startswith("base.")}
        for index, value in enumerate(weights["latent_nominal"].tolist()):
            own[f"base.{LATENT_PREFIX}{index}"] = Setting(value, free=True)
        acting = {path: value for path, value in physics.settings.items() if not path.startswith("base.")}
        self._alone = PhysicsModel(base, (), own, physics.period)
        self._acted_on = PhysicsModel(base, physics.effects, {**own, **acting}, physics.period)
        named = [path.startswith("base.") for path in physics.latent_names]
        self._of_effects = [index for index, of_base in enumerate(named) if not of_base]
        """Which entries of e belong to effects; the robot's own numbers are those of the tuned networks."""

    def settled(self, action: Tensor, latent: Tensor, environment: Tensor) -> Any:
        """What actuator effects remember after an action has been held for long."""
        return self._acted_on.initial_memory(action, self._everything(latent, environment))

    def advance(
        self, state: Tensor, action: Tensor, latent: Tensor, environment: Tensor, memory: Any
    ) -> tuple[Tensor, Tensor, Any]:
        """The next states with effects and without (n, states), and the actuator effects' memory."""
        free = self._alone.advance(state, action, (), latent)[0]
        acted_on, memory = self._acted_on.advance(state, action, memory, self._everything(latent, environment))
        half = 0.5 * (acted_on - free)
        following = self._alone.advance(state + half, action, (), latent)[0] + half
        return following, free, memory

    def _everything(self, latent: Tensor, environment: Tensor) -> Tensor:
        return torch.cat((latent, environment[:, self._of_effects]), dim=1)


def imagined_drives(
    cars: BatchedCars,
    weights: Weights,
    networks: AffineNetworks,
    encoder: HistoryNetwork,
    count: int,
    steps: int,
    change: float,
    generator: torch.Generator,
) -> Lived:
    """``count`` drives of ``steps`` periods under ``RandomDriver``; weights, networks and encoder are the tuned ones.

    Every car begins at rest, as a robot does; environments change with probability ``change`` in a period.
    """
    imagined, driver = ImaginedCars(cars, weights), RandomDriver(cars, count, generator)
    environment = cars.draw_environments(count, generator)
    state = cars.draw_states(count, generator)
    state[:, [cars.model.system.state_names.index("speed")]] = 0.0
    sizes = networks.sizes
    seen = torch.zeros(
        count, weights.description.history, sizes.features + sizes.states + sizes.actions, device=cars.device
    )
    memory, states, actions, environments = None, [state], [], []
    with torch.no_grad():
        for _ in range(steps):
            action, latent = driver.action(), encoder(seen)
            memory = imagined.settled(action, latent, environment) if memory is None else memory
            following, free, memory = imagined.advance(state, action, latent, environment, memory)
            seen = torch.cat((seen[:, 1:], history_rows(networks, state, action, free).unsqueeze(1)), dim=1)
            states.append(following)
            actions.append(action)
            environments.append(environment)
            state = following
            changes = torch.rand(count, 1, generator=generator, device=cars.device) < change
            environment = torch.where(changes, cars.draw_environments(count, generator), environment)
        return lived(networks, torch.stack(states, 1), torch.stack(actions, 1), torch.stack(environments, 1))
