"""Animates the same drive with and without the filter: ``python docs/draw_drives.py [FILE.gif]``.

A car tows a chair that its model does not know. Its policy drives straight at the goals and knows no obstacles.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon

from safedpa.bus import StateMessage
from safedpa.dynamics import load_model
from safedpa.safety.defaults import settings_named
from safedpa_lab.experiments.common.drives import shipped_nodes
from safedpa_sim.closed_loop import drive
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene

FILE = Path(__file__).parent / "pictures" / "drives.gif"
SEED, SECONDS, PERIOD, EVERY = 2, 14.0, 0.05, 3
"""Scene, duration [s], period [s], and ticks per picture."""


def states(*, filtered: bool, seconds: float = SECONDS) -> list[StateMessage]:
    """The state messages of one drive."""
    settings = replace(settings_named("car"), enabled=filtered)
    nodes = shipped_nodes(load_model("car"), settings)
    robot = CarRobot(Scene.random(SEED, "chair"), PERIOD)
    return [tick.state for tick in drive(robot, nodes, round(seconds / PERIOD))]


def corners(x: float, y: float, yaw: float, rear: float, front: float, half: float) -> np.ndarray:
    """Corners (4, 2) of a rectangle, from ``rear`` behind to ``front`` ahead of a pose [m]."""
    own = np.array([[-rear, -half], [front, -half], [front, half], [-rear, half]])
    turned = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    return np.asarray(np.array([x, y]) + own @ turned)


def animate(path: Path, seconds: float = SECONDS) -> None:
    """Writes the animation."""
    drives = {
        "without the filter": states(filtered=False, seconds=seconds),
        "with the filter": states(filtered=True, seconds=seconds),
    }
    figure = Figure(figsize=(7.2, 3.8), layout="constrained")
    moving: list[tuple[Any, ...]] = []
    for axes, messages in zip(figure.subplots(1, 2), drives.values(), strict=True):
        first = messages[0]
        for x, y, radius in first.obstacles:
            axes.add_patch(Circle((x, y), radius, color="0.7"))
        axes.set(xlim=first.field[:2], ylim=first.field[2:], aspect="equal", xticks=[], yticks=[])
        car, load = Polygon(np.zeros((4, 2)), color="tab:blue"), Polygon(np.zeros((4, 2)), color="tab:orange")
        axes.add_patch(load)
        axes.add_patch(car)
        (trace,) = axes.plot([], [], color="tab:blue", linewidth=1, alpha=0.5)
        (goal,) = axes.plot([], [], "k*")
        moving.append((axes, car, load, trace, goal))

    def show(frame: int) -> None:
        for (axes, car, load, trace, goal), (name, messages) in zip(moving, drives.items(), strict=True):
            now = messages[frame]
            x, y, yaw, _ = now.values
            car.set_xy(corners(x, y, yaw, 0.08, 0.40, 0.12))
            car.set_color("tab:red" if now.collisions else "tab:blue")
            px, py, turned, length, width = now.load_pose
            load.set_xy(corners(px, py, turned, length / 2, length / 2, width / 2))
            trace.set_data(*np.array([message.values[:2] for message in messages[: frame + 1]]).T)
            goal.set_data([now.goal[0]], [now.goal[1]])
            axes.set_title(f"{name}: {now.goals_reached} goals, {now.collisions} collisions", fontsize=10)

    frames = range(0, len(drives["with the filter"]), EVERY)
    FuncAnimation(figure, show, frames=frames).save(path, writer=PillowWriter(fps=round(1.0 / PERIOD / EVERY)), dpi=80)


if __name__ == "__main__":
    animate(Path(sys.argv[1]) if sys.argv[1:] else FILE)
