"""Simulated car steps for training, next to one car at a time."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np

from safedpa.dynamics import load_model
from safedpa_lab.benchmarks.results import Curve, Effort, Entry, Row, Target, missing, steps
from safedpa_lab.benchmarks.timing import rate

_PERIOD = 0.05
_STEPS = 20


def measure(effort: Effort) -> Row:
    """Steps of 0.05 s a second: the randomised simulator of phase 1a for several sizes of batch, and single cars."""
    sizes = effort.of((256, 4096), (1, 16, 256, 1024, 4096, 8192, 16384))
    seconds = effort.of(0.3, 2.0)
    found = {size: _batched(size, seconds) for size in sizes}
    best = max(found, key=lambda size: found[size]["per_second"])
    ours = tuple(steps(f"safedpa, {size} cars at once", found[size]) for size in dict.fromkeys((best, sizes[0])))
    series: dict[str, tuple[float | None, ...]] = {"safedpa": tuple(found[size]["per_second"] for size in sizes)}
    curve = Curve("car_steps", "cars in a batch", "steps a second", tuple(float(size) for size in sizes), series)
    target = Target("car steps a second", 5e6, found[best]["per_second"], "steps/s", "more")
    work = "one step of 0.05 s of a simulated car with load, wind and wear drawn at random"
    peers = (_pymunk(seconds), _gymnasium_car(seconds), _gymnasium_vector(seconds))
    return Row("car-steps", work, "per_second", ours, peers, (target,), (curve,), better="more")


def _batched(count: int, seconds: float) -> dict[str, float]:
    import torch

    from safedpa_sim.training.configuration import load_configuration
    from safedpa_sim.training.environments.batched_simulator import BatchedSimulator

    cars = BatchedSimulator(load_configuration("car"))
    generator = cars.generator(0)
    environment, action = cars.draw_environments(count, generator), cars.draw_actions(count, generator)
    state = cars.draw_states(count, generator)
    memory = cars.settled(action, environment)

    def several() -> None:
        now, retained = state, memory
        with torch.no_grad():
            for _ in range(_STEPS):
                now, retained = cars.advance(now, action, environment, retained)

    return rate(several, count * _STEPS, seconds)


def _pymunk(seconds: float) -> Entry:
    from safedpa_sim.robots.car.loads import load_named
    from safedpa_sim.robots.car.world import CarWorld

    world = CarWorld((0.0, 0.0, 0.0), (-1e4, 1e4, -1e4, 1e4), load=load_named("chair"))

    note = "a rigid body with tyres and a towed chair, 20 physics steps of 2.5 ms each; one car after the other"
    return steps("pymunk, one by one", rate(lambda: world.advance(1.0, 0.1, _PERIOD), 1, seconds, times=_STEPS), note)


def _gymnasium_car(seconds: float) -> Entry:
    """The kinematic car of this project's model file behind gymnasium's interface, one at a time."""
    name = "gymnasium, one by one"
    try:
        gymnasium: Any = importlib.import_module("gymnasium")
    except ImportError:
        return missing(name, "gymnasium is not installed; pip install 'safedpa[gym]'")
    model = load_model("car")

    class Car(gymnasium.Env):  # type: ignore[misc]
        action_space = gymnasium.spaces.Box(np.array([-0.6, -0.34]), np.array([2.0, 0.34]), dtype=np.float64)
        observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (4,), np.float64)

        def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
            super().reset(seed=seed, options=options)
            self.state, self.memory = np.zeros(4), model.initial_memory(np.zeros(2))
            return self.state, {}

        def step(self, action: Any) -> Any:
            self.state, self.memory = model.advance(self.state, action, self.memory, model.latent)
            return self.state, float(self.state[3]), False, False, {}

    environment = gymnasium.wrappers.TimeLimit(Car(), 1_000_000_000)
    environment.reset(seed=0)
    action = np.array([1.0, 0.1])

    found = rate(lambda: environment.step(action), 1, seconds, times=_STEPS)
    return steps(name, found, "this project's kinematic car with a towed load, as an environment")


def _gymnasium_vector(seconds: float) -> Entry:
    """What gymnasium itself does for many: its own pendulum, the lightest continuous environment that it ships."""
    name = "gymnasium, 64 in a vector"
    try:
        gymnasium: Any = importlib.import_module("gymnasium")
    except ImportError:
        return missing(name, "gymnasium is not installed; pip install 'safedpa[gym]'")
    environments = gymnasium.make_vec("Pendulum-v1", num_envs=64, vectorization_mode="sync")
    environments.reset(seed=0)
    actions = environments.action_space.sample()

    found = rate(lambda: environments.step(actions), 64, seconds, times=_STEPS)
    return steps(name, found, "its own Pendulum-v1, which has two states and no load")
