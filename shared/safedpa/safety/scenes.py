"""What builds the barriers around a robot: the robot's own, found by the states and actions of its model."""

from __future__ import annotations

from safedpa.dynamics import AbstractDynamics
from safedpa.errors import InputError
from safedpa.robot import robot_like, robots
from safedpa.safety.compatibility import check_margins, check_settings
from safedpa.safety.scene import AbstractScene, DeclaredScene
from safedpa.safety.settings import FilterSettings
from safedpa.systems import System

__all__ = ["scene_of"]


def scene_of(model: AbstractDynamics, settings: FilterSettings) -> AbstractScene:
    """The barriers' builder for one robot.

    Raises InputError for a robot whose barriers nobody wrote, settings of another one, or margins of unknown kinds.
    """
    robot = robot_like(model.system)
    if robot is None:
        raise InputError(_nobody(model.system))
    check_settings(settings, model.system)
    scene = robot.scene(model, settings) or DeclaredScene(robot, model, settings)
    check_margins(settings.epsilon, ())
    return scene


def _nobody(system: System) -> str:
    known = [one.system for one in robots().values()]
    told = "; ".join(f"{', '.join(item.state_names)} with {', '.join(item.action_names)}" for item in known)
    return (
        f"model: of the system '{system.name}', {', '.join(system.state_names)} with "
        f"{', '.join(system.action_names) or 'no action'}; the service has barriers for {told}; declare a robot of "
        "your own (--robot-file), or filter it with the library, which takes barriers of your own"
    )
