"""The point robot among hazards; read ``robot``, then ``system`` and ``point_mass`` (base model).

``scene`` builds barriers with a backup manoeuvre from each state message, ``goal_seeker`` is the controller.
"""

from safedpa.robots.point.robot import ROBOT, Point

__all__ = ["ROBOT", "Point"]
