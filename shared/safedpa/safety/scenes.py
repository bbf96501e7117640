"""What builds the barriers around a robot, by the states and actions of its model."""

from __future__ import annotations

from typing import TypeAlias

from safedpa.dynamics import AbstractDynamics
from safedpa.safety.compatibility import check_margins, check_settings
from safedpa.safety.point_scene import PointScene
from safedpa.safety.scene import SceneBarriers, is_of
from safedpa.safety.settings import FilterSettings
from safedpa.systems import POINT

__all__ = ["Scene", "scene_of"]

Scene: TypeAlias = SceneBarriers | PointScene


def scene_of(model: AbstractDynamics, settings: FilterSettings) -> Scene:
    """The barriers' builder for one robot.

    Raises InputError for a robot whose barriers nobody wrote, settings of another one, or margins of unknown kinds.
    """
    scene = PointScene(model, settings) if is_of(model.system, POINT) else SceneBarriers(settings, model.system)
    check_settings(settings, model.system)
    check_margins(settings.epsilon, ())
    return scene
