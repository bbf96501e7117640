"""The pendulum: system, base, effects, corridor, observation."""

from safedpa.robots.pendulum.robot import ROBOT, Pendulum

__all__ = ["ROBOT", "Pendulum"]
