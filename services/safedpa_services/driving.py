"""From a model on disk to driving it: whether ``safedpa up`` takes it, and by which command."""

from __future__ import annotations

import os
import shlex
from pathlib import Path

from safedpa.dynamics import LearnedBase, PhysicsModel
from safedpa.dynamics.own import EFFECTS_VARIABLE
from safedpa.errors import InputError
from safedpa.robot import DEFAULT_ROBOT, own_robots, robot_named
from safedpa.systems.driven import why_not_driven

__all__ = ["drive_command", "why_refused"]

_SAME_RATE = 0.01
"""Relative difference of periods up to which networks are asked as they were trained."""


def why_refused(model: PhysicsModel) -> str:
    """Why ``safedpa up`` would refuse to drive this model with its robot's own settings; empty where it would not."""
    from safedpa.policy.controller import controller_for
    from safedpa.safety.scenes import scene_of

    name = model.system.name
    refusal = why_not_driven(model.system, name)
    if refusal:
        return refusal
    robot = robot_named(name).of_system(model.system)
    try:
        scene_of(model, robot.settings())
        controller_for(model)
    except InputError as error:
        return str(error)
    if isinstance(model.base, LearnedBase) and abs(robot.rate * model.period - 1.0) > _SAME_RATE:
        trained = 1.0 / model.period
        return f"its networks were trained for {trained:g} ticks per second, a {name} is driven at {robot.rate:g}"
    return ""


def drive_command(model: PhysicsModel, path: Path, margin: Path | None, own: Path | None = None) -> str:
    """The command that drives the simulated robot with the model at ``path``, for a shell.

    ``own``: the file of the user's own robot or effects; None: that of the environment, if one is named there.
    """
    name = model.system.name
    files = [str(own)] if own else [item for item in os.environ.get(EFFECTS_VARIABLE, "").split(os.pathsep) if item]
    words = ["safedpa", "up"]
    if name != DEFAULT_ROBOT and name not in own_robots():
        words += ["--robot", name]
    if files:
        words += ["--robot-file" if name in own_robots() else "--effects", files[0]]
    words += ["--model", str(path), *(["--margin", str(margin)] if margin else [])]
    return shlex.join(words)
