"""Controllers that wish for an action; none of them is trusted, all of them are filtered."""

from safedpa.policy.controller import CONTROLLERS, Controller
from safedpa.policy.goal_seeker import GoalSeeker, GoalSeekerSettings
from safedpa.policy.learned import LearnedPolicy
from safedpa.policy.node import PolicyNode

__all__ = ["CONTROLLERS", "Controller", "GoalSeeker", "GoalSeekerSettings", "LearnedPolicy", "PolicyNode"]
