"""Controllers that wish for an action; none of them is trusted, all of them are filtered."""

from safedpa.policy.goal_seeker import GoalSeeker, GoalSeekerSettings
from safedpa.policy.node import PolicyNode

__all__ = ["GoalSeeker", "GoalSeekerSettings", "PolicyNode"]
