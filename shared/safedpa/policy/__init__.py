"""Controllers that request an action; none of them is trusted, all of them are filtered."""

from safedpa.policy.controller import Controller, controller_for
from safedpa.policy.learned import LearnedPolicy
from safedpa.policy.node import PolicyNode

__all__ = ["Controller", "LearnedPolicy", "PolicyNode", "controller_for"]
