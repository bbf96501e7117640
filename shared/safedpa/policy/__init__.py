"""Policies, which propose nominal actions. None of them is trusted; the safety filter checks every action.

``controller`` selects a controller by name, ``learned`` is a trained policy, ``perception`` builds its observations,
and ``backing_off`` frees a car that is stuck. ``node`` is the service. Read ``controller.py`` first.
"""

from safedpa.policy.controller import Controller, controller_for
from safedpa.policy.learned import LearnedPolicy
from safedpa.policy.node import PolicyNode

__all__ = ["Controller", "LearnedPolicy", "PolicyNode", "controller_for"]
