"""The car with front steering, the largest of the shipped robots; read ``robot`` and ``system`` first.

``dynamics`` holds base model and limits, ``effects`` its effects, ``barriers`` the barrier equations and ``scenes`` the
barriers of a scene. ``controllers`` are goal seeker, route follower and MPPI planner, ``observation`` and
``perception`` the input of a learned policy, ``adapters`` ROS and Gazebo.
"""

from safedpa.robots.car.robot import ROBOT, Car

__all__ = ["ROBOT", "Car"]
