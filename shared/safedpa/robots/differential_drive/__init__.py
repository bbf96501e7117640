"""The differential drive: system, base, effects, barriers around two braking wheels, goal seeker, drawing."""

from safedpa.robots.differential_drive.robot import ROBOT, DifferentialDrive

__all__ = ["ROBOT", "DifferentialDrive"]
