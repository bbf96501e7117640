"""The inverted pendulum, the smallest example; read ``robot``, then ``system`` and ``rigid_pendulum`` (base model).

``scene`` holds the corridor barrier, ``perception`` the observation of a learned policy, and ``simulator_export``
writes MuJoCo and URDF files.
"""

from safedpa.robots.pendulum.robot import ROBOT, Pendulum

__all__ = ["ROBOT", "Pendulum"]
