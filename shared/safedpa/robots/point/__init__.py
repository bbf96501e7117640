"""The point robot: system, base, effects, hazards with a stopping manoeuvre, goal seeker."""

from safedpa.robots.point.robot import ROBOT, Point

__all__ = ["ROBOT", "Point"]
