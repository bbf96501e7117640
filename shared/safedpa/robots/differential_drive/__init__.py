"""The differential drive, a self-contained example to copy; read ``robot``, then ``system`` and ``servo_wheels``.

``barriers`` holds its own barrier equations, ``goal_seeker`` the controller, ``ros_face`` the ROS interface.
"""

from safedpa.robots.differential_drive.robot import ROBOT, DifferentialDrive

__all__ = ["ROBOT", "DifferentialDrive"]
