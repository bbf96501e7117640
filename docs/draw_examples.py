"""Draws the pictures of the gallery's examples: ``python docs/draw_examples.py [FOLDER]`` (docs/pictures/examples)."""

from __future__ import annotations

import base64
import json
import runpy
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from safedpa.dynamics import load_model, load_user_file
from safedpa.safety import SafetyFilter

DOCS = Path(__file__).parent
EXAMPLES, FOLDER = DOCS / "examples", DOCS / "pictures" / "examples"
SCRIPTS = {
    "unicycle": "unicycle_among_discs.py",
    "training": "train_behind_the_filter.py",
    "vector": "vector_environment.py",
}


def path_of(file: str, name: str, seconds: float, nominal: Any = None, *, filtered: bool = True) -> Any:
    """States (k, n) of a simulated robot of an example behind its own filter, and its simulation."""
    load_user_file(EXAMPLES / file)
    own = runpy.run_path(str(EXAMPLES / file))
    robot: Any = own[name]()
    model, settings, world = load_model(robot.model), robot.settings(), robot.stand_in(1, {})
    safe = SafetyFilter.for_model(model, settings, backup=lambda x: robot.backup(x, model, settings))
    controller = robot.controllers(model)["goal_seeker"]()
    states = [np.array(world.values)]
    for _ in range(round(seconds * robot.rate)):
        seen = SimpleNamespace(values=world.values, goal=world.goal, obstacles=world.obstacles, field=world.field)
        action = nominal if nominal is not None else controller.nominal_action(seen, model.latent)[0]
        if filtered:
            barriers = robot.barriers(seen, model, model.latent, settings)
            action = safe.decide(world.values, action, model.latent, barriers=barriers).action
        world.advance(action, 1.0 / robot.rate)
        states.append(np.array(world.values))
    return np.array(states), world


def draw_cleaner(path: Path) -> None:
    """A drive among obstacles, from above."""
    states, world = path_of("cleaner/cleaner.py", "Cleaner", 40.0)
    axes = (figure := Figure(figsize=(4.0, 4.0), layout="constrained")).subplots()
    for x, y, radius in world.obstacles:
        axes.add_patch(Circle((x, y), radius, color="0.75"))
    axes.plot(states[:, 0], states[:, 1])
    axes.set(xlabel="x [m]", ylabel="y [m]", xlim=world.field[:2], ylim=world.field[2:], aspect="equal")
    figure.savefig(path, dpi=100)


def draw_quadrotor(path: Path) -> None:
    """Full climb requested, with and without the filter: the height."""
    axes = (figure := Figure(figsize=(6.4, 3.0), layout="constrained")).subplots()
    for label, filtered in (("without filter", False), ("with filter", True)):
        states, _ = path_of("quadrotor/quadrotor.py", "Quadrotor", 3.0, (12.0, 0.0, 0.0, 0.0), filtered=filtered)
        axes.plot(np.linspace(0.0, 3.0, len(states)), states[:, 2], label=label)
    axes.axhline(runpy.run_path(str(EXAMPLES / "quadrotor" / "quadrotor.py"))["HIGHEST"], color="k", linestyle="--")
    axes.set(xlabel="t [s]", ylabel="height [m]")
    axes.legend()
    figure.savefig(path, dpi=100)


def draw_notebook(path: Path) -> None:
    """The first figure of the notebook that diagnoses a log."""
    notebook = json.loads((DOCS / "tutorials" / "diagnose_a_log.ipynb").read_text(encoding="utf-8"))
    outputs = (output for cell in notebook["cells"] for output in cell.get("outputs", ()))
    pictures = [data["image/png"] for output in outputs if "image/png" in (data := output.get("data", {}))]
    path.write_bytes(base64.b64decode(pictures[0]))


def draw(folder: Path = FOLDER) -> None:
    """Draws all of them."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, file in SCRIPTS.items():
        sys.stdout.write(runpy.run_path(str(EXAMPLES / file))["main"]([str(folder / f"{name}.png")]))
    with tempfile.TemporaryDirectory() as made:
        sys.stdout.write(runpy.run_path(str(EXAMPLES / "read_a_bag.py"))["main"]([made, str(folder / "bag.png")]))
    draw_cleaner(folder / "cleaner.png")
    draw_quadrotor(folder / "quadrotor.png")
    draw_notebook(folder / "notebook.png")


if __name__ == "__main__":
    draw(*(Path(argument) for argument in sys.argv[1:2]))
