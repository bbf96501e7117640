"""A method at the wheel of all robots of a task, for one episode: its policy with its inputs, behind its filter."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from hashlib import sha256
from pathlib import Path
from time import process_time
from typing import Any, Protocol, final

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import BoolArray, FloatArray
from safedpa.errors import InputError
from safedpa.networks import Weights
from safedpa.robots.point.goal_seeker import goal_seeking_action
from safedpa_lab.point.baseline_set import baseline_named, seeds_of
from safedpa_lab.point.beliefs import LearnedBelief, weights_named
from safedpa_lab.point.inputs import Inputs
from safedpa_lab.point.methods import METHODS, PENALISED, SEEKER, Method
from safedpa_lab.point.shield import Shield, shield_of
from safedpa_sim.point.filtering import AbstractPointModel, around_hazards, to_task_action
from safedpa_sim.point.observation import policy_seen
from safedpa_sim.point.route_planner import RoutePlanner
from safedpa_sim.point.simulation import centre_state
from safedpa_sim.point.task import EPISODE_STEPS, PointTask


class Driver(Protocol):
    """A method at the wheel of all robots of a task."""

    corrected: BoolArray
    """(robots,): where the last action is not the nominal action."""
    relaxed: BoolArray
    """(robots,): where not every condition could be kept."""

    def act(self) -> NDArray[np.floating[Any]]:
        """Actions (robots, 2) in [-1, 1] for the task as it is."""


class _Acts(Protocol):
    """A policy: what it is given, actions out."""

    def act(self, seen: NDArray[np.float32]) -> NDArray[np.float32]:
        """Actions (robots, 2) for what is seen (robots, entries)."""


@final
class PolicyDriver:
    """A policy that acts by itself; nothing is corrected."""

    def __init__(self, task: PointTask, policy: _Acts, inputs: Inputs) -> None:
        self._policy, self._inputs = policy, inputs
        self.corrected = self.relaxed = np.zeros(task.count, bool)

    def act(self) -> NDArray[np.float32]:  # noqa: D102
        return self._policy.act(self._inputs.see())


@final
@dataclass(frozen=True)
class Driven:
    """One entry a robot, each an episode."""

    goals: FloatArray
    reward: FloatArray
    cost: FloatArray
    """Steps within a hazard."""
    least_room: FloatArray
    """m to the nearest hazard's edge, at the closest."""
    first_goal: FloatArray
    """s until the first goal; infinite where there was none."""
    corrected: float
    """Share of all steps."""
    relaxed: float
    """Share of all steps in which not every condition could be kept."""
    processor_seconds: float
    """In the method's own decisions, all robots together."""
    shown: list[dict[str, Any]]
    """Paths of the robots that were asked for: places, whether within a hazard, goals in their order, hazards."""


def evenly(directions: int, episodes: int) -> FloatArray:
    """[rad] of ``directions`` x ``episodes`` robots: robot i towards 360 degrees (i // episodes) / directions."""
    return np.repeat(2.0 * np.pi * np.arange(directions) / directions, episodes)


def windy_task(towards: FloatArray, force: float, seed: int, *, stock: bool = False) -> PointTask:
    """One robot for each direction [rad] of a wind's force [N]; layouts, headings and goals are the seed's alone."""
    task = PointTask(len(towards), seed, paired=True, stock=stock)
    task.simulation.force[:] = force * np.stack((np.cos(towards), np.sin(towards)))
    return task


def driven(
    driver: Driver, task: PointTask, steps: int = EPISODE_STEPS, shown: NDArray[np.intp] | None = None
) -> Driven:
    """Drives all robots of the task, just begun, for so many steps."""
    watch = _Watch(task, np.zeros(0, int) if shown is None else shown)
    corrected = relaxed = worked = 0.0
    for step in range(steps):
        began = process_time()
        action = driver.act()
        worked += process_time() - began
        watch.see(step, task.advance(action))
        corrected += float(driver.corrected.mean())
        relaxed += float(driver.relaxed.mean())
    return Driven(
        watch.goals,
        watch.reward,
        watch.cost,
        watch.least_room,
        watch.first_goal,
        corrected / steps,
        relaxed / steps,
        worked,
        watch.reported(),
    )


class _Watch:
    """What happens to each robot."""

    def __init__(self, task: PointTask, shown: NDArray[np.intp]) -> None:
        self.goals, self.reward, self.cost = np.zeros(task.count), np.zeros(task.count), np.zeros(task.count)
        self.least_room = task.hazard_distance()
        self.first_goal = np.full(task.count, np.inf)
        self._task, self._shown = task, shown
        self._places: list[FloatArray] = []
        self._within: list[FloatArray] = []
        self._met: list[list[list[float]]] = [[_pair(goal)] for goal in task.layout.goal[shown]]
        self._met_at: list[list[int]] = [[] for _ in shown]

    def see(self, step: int, stepped: Any) -> None:
        task, shown = self._task, self._shown
        self.goals += stepped.reached
        self.reward += stepped.reward
        self.cost += stepped.cost
        self.least_room = np.minimum(self.least_room, task.hazard_distance())
        self.first_goal[stepped.reached & np.isinf(self.first_goal)] = 0.02 * (step + 1)
        self._places.append(task.simulation.pose[:2, shown].T.copy())
        self._within.append(stepped.cost[shown] > 0.0)
        for place in np.flatnonzero(stepped.reached[shown]):
            self._met_at[place].append(step)
            self._met[place].append(_pair(task.layout.goal[shown[place]]))

    def reported(self) -> list[dict[str, Any]]:
        places, within = np.round(np.array(self._places), 3), np.array(self._within)
        return [
            {
                "robot": int(robot),
                "places": places[:, index].tolist(),
                "within": within[:, index].tolist(),
                "goals": self._met[index],
                "reached_at": self._met_at[index],
                "hazards": np.round(self._task.layout.hazards[robot], 3).tolist(),
            }
            for index, robot in enumerate(self._shown)
        ]


def _pair(place: FloatArray) -> list[float]:
    return [round(float(part), 3) for part in place]


NominalPolicy = Callable[[FloatArray], NDArray[np.floating[Any]]]


@final
@dataclass(frozen=True)
class Wheel:
    """Where weights are looked for before those that ship, and what is left open by a method's name."""

    models: Path = Path()
    baselines: Path = Path()
    margins: Mapping[str, float] = field(default_factory=dict)
    """m, by filter."""
    seed: int | None = None
    """Of a baseline's training; nothing: the first that there is."""


@final
class ShieldedDriver:
    """A nominal action, of the latents as they are, through the filter."""

    def __init__(self, task: PointTask, shield: Shield, nominal: NominalPolicy) -> None:
        self.task, self.shield, self._nominal = task, shield, nominal
        self.corrected = self.relaxed = np.zeros(task.count, bool)

    def act(self) -> FloatArray:  # noqa: D102
        nominal = self._nominal(self.shield.see(self.task))
        found = self.shield.act(self.task, nominal)
        self.corrected, self.relaxed = found.corrected, found.relaxed
        return found.action


def driver_of(method: Method, task: PointTask, wheel: Wheel) -> Driver:
    """The method at the wheel of a task's robots; weights from the folders, or else those that ship.

    Raises InputError where there are none, or no margin for its filter.
    """
    adapts = method.policy if method.policy not in ("", SEEKER) else "learned"
    if method.baseline:
        policy = baseline_named(method.baseline, wheel.baselines, _seed(method, wheel))
        inputs = Inputs(policy.inputs, task, wheel.models)
        if not method.filter:
            return PolicyDriver(task, policy, inputs)
        nominal: NominalPolicy = lambda _: policy.act(inputs.see())  # noqa: E731
    elif method.policy == SEEKER:
        nominal = _seeking(task, LearnedBelief(weights_named("learned", wheel.models)))
    else:
        nominal = learned_policy(task, weights_named(method.policy, wheel.models))
    if not method.filter:
        return ShieldedDriver(task, shield_of("none", task, adapts=adapts, folder=wheel.models), nominal)
    if method.filter not in wheel.margins:
        raise InputError(f"{method.name}: got no margin for the filter '{method.filter}', wanted one of every filter")
    epsilon = wheel.margins[method.filter]
    shield = shield_of(method.filter, task, epsilon=epsilon, adapts=adapts, folder=wheel.models)
    return ShieldedDriver(task, shield, nominal)


def training_seeds(method: Method, baselines: Path) -> tuple[int | None, ...]:
    """Of which there are policies of a method: each is driven. One of nothing where it is no baseline's."""
    return seeds_of(method.baseline, baselines) if method.baseline else (None,)


def digest_of(method: Method, wheel: Wheel) -> str:
    """Of the weights of a method's policy, where it has any. Raises InputError where there are none."""
    if method.baseline:
        policy = baseline_named(method.baseline, wheel.baselines, _seed(method, wheel))
        parts = (part.tobytes() for _, part in sorted(policy.tensors.items()))
        return sha256(b"".join(parts)).hexdigest()[:16]
    return "" if method.policy == SEEKER else weights_named(method.policy, wheel.models).digest[:16]


def penalised(models: Path) -> tuple[str, ...]:
    """Those of RMA-P's grid that are in the folder or ship."""
    found = []
    for name in PENALISED:
        with contextlib.suppress(InputError):
            weights_named(name, models)
            found.append(name)
    return tuple(found)


def with_weights(models: Path, baselines: Path) -> tuple[str, ...]:
    """Those of ``METHODS`` whose weights are in the folders or ship."""
    task, found = PointTask(1, 0), []
    for name, method in METHODS.items():
        with contextlib.suppress(InputError):
            own = penalised(models) or (method.policy,) if name == "rma_p" else (method.policy,)
            driver_of(replace(method, policy=own[0]), task, Wheel(models, baselines, {method.filter: 0.0}))
            found.append(name)
    return tuple(found)


def _seed(method: Method, wheel: Wheel) -> int:
    if wheel.seed is not None:
        return wheel.seed
    return next(iter(seeds_of(method.baseline, wheel.baselines)), 0)


def learned_policy(task: PointTask, weights: Weights) -> NominalPolicy:
    """The actions (robots, 2) of the networks' policy for latents (robots, latents)."""
    from safedpa_sim.point.latent_policy import LatentPolicy

    learned, ways = LatentPolicy(weights), RoutePlanner(task.count)

    def nominal_action(latent: FloatArray) -> NDArray[np.floating[Any]]:
        place, layout = task.simulation.pose[:2].T, task.layout
        turn, _ = ways.first_turns(place, layout.hazards, layout.goal)
        return learned.act(policy_seen(task, latent, turn))

    return nominal_action


def _seeking(task: PointTask, belief: AbstractPointModel) -> NominalPolicy:
    """The robot's own goal seeker, in the wind that the latent stands for."""

    def nominal_action(latent: FloatArray) -> FloatArray:
        state, layout = centre_state(task.simulation), task.layout
        believed = belief.predict(state, latent)
        hazards = around_hazards(layout.hazards, believed.motion).hazards
        found = []
        for robot in range(task.count):
            motion = believed.motion.of(robot)
            found.append(
                goal_seeking_action(state[robot], layout.goal[robot], hazards[robot], motion.wind, float(motion.drag))
            )
        return to_task_action(np.clip(found / believed.scale, -1.0, 1.0))

    return nominal_action
