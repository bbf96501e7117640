"""Steps of the point robot, next to MuJoCo on the same model and the benchmark it comes from."""

from __future__ import annotations

import importlib
from functools import partial
from typing import Any

import numpy as np

from safedpa_lab.benchmarks.results import Curve, Effort, Entry, Row, Target, missing, steps
from safedpa_lab.benchmarks.timing import rate

_STEPS = 50
_SOURCE = (
    "not measured here: it does not install on Python 3.11; 627 steps/s where it ran, with old pins, on another machine"
)


def measure(effort: Effort) -> Row:
    """Steps of 20 ms, ten physics steps each, on one core."""
    from safedpa_sim.point.simulation import PointSimulation
    from safedpa_sim.point.task import PointTask

    seconds = effort.of(0.2, 2.0)
    sizes = effort.of((16, 128), (1, 4, 16, 64, 128, 512, 2048))
    random = np.random.default_rng(0)
    found: dict[str, dict[int, dict[str, float]]] = {"body alone": {}, "whole task": {}}
    for size in sizes:
        actions = random.uniform(-1.0, 1.0, (size, 2))
        alone = partial(PointSimulation(size).advance, 0.05 * actions.T)
        found["body alone"][size] = rate(alone, size, seconds, times=_STEPS)
        found["whole task"][size] = rate(partial(_whole, PointTask(size, 0), actions), size, seconds, times=_STEPS)
    ours = []
    for what, own in found.items():
        best = max(own, key=lambda size: own[size]["per_second"])
        note = "reward, cost, observation and new goals too" if what == "whole task" else "ten physics steps each"
        ours.append(steps(f"safedpa, {what}, {best} at once", own[best], note, what))
    target = Target(
        "point robot steps a second, whole task", 20_000.0, ours[1].figures["per_second"], "steps/s", "more"
    )
    series: dict[str, tuple[float | None, ...]] = {
        f"safedpa, {what}": tuple(own[size]["per_second"] for size in sizes) for what, own in found.items()
    }
    curve = Curve("point_steps", "robots in a batch", "steps a second", tuple(map(float, sizes)), series)
    peers = (_mujoco(seconds), _environment(seconds), _safety_gymnasium())
    work = "one step of 20 ms of the point robot (ten physics steps)"
    return Row("point-steps", work, "per_second", tuple(ours), peers, (target,), (curve,), better="more")


def _whole(task: Any, actions: Any) -> None:
    task.advance(actions)
    task.observation()


def _mujoco(seconds: float) -> Entry:
    name = "mujoco, one robot"
    try:
        importlib.import_module("mujoco")
    except ImportError:
        return missing(name, "mujoco is not installed; pip install 'safedpa[train]'", "body alone")
    from safedpa_lab.point.world import MujocoPoint
    from safedpa_sim.point.layout import draw_layouts

    hazards = draw_layouts(1, np.random.default_rng(0)).hazards[0]
    world = MujocoPoint([(float(x), float(y)) for x, y in hazards])
    found = rate(lambda: world.advance(np.array([0.03, 0.4])), 1, seconds, times=_STEPS)
    return steps(name, found, "the same MJCF, ten mj_step and the sensors each", "body alone")


def _environment(seconds: float) -> Entry:
    name = "mujoco behind gymnasium, one robot"
    try:
        importlib.import_module("mujoco")
        importlib.import_module("gymnasium")
    except ImportError as error:
        return missing(name, f"{error.name} is not installed; pip install 'safedpa[train]'", "whole task")
    from safedpa_lab.point.gym_environment import PointGoalEnvironment

    environment = PointGoalEnvironment()
    environment.reset(seed=0)
    action = np.array([0.5, 0.3])
    found = rate(lambda: environment.step(action), 1, seconds, times=_STEPS)
    return steps(name, found, "this project's environment around it: reward, cost, observation", "whole task")


def _safety_gymnasium() -> Entry:
    """Does not install on this Python; what it does where it runs is printed with its source."""
    return Entry("safety-gymnasium (printed)", {"per_second": 627.0}, "steps/s", problem="whole task", note=_SOURCE)
