"""The shipped robots, one package each; everything specific to a robot is in its package.

Which package to copy for your own robot:

- ``pendulum``: the smallest one; a single constraint (a corridor of angles) and no controller of its own.
- ``differential_drive``: a mobile robot with its own barrier equations, ROS interface and drawing; start here.
- ``point``: barriers and backup manoeuvre that depend on the estimated latent.
- ``car``: everything at once, including perceived surroundings, a towed load and three controllers.

In each package read ``robot`` first: it declares what the robot has and names the modules that hold it. ``system``
defines state and action. Your own package need not be in this folder: ``safedpa.robot`` documents the declaration.
"""

__all__ = ["DEFAULT"]

DEFAULT = "car"
"""The robot that is used when none is named."""
