"""Barriers h >= 0 define the safe set.

Read ``base`` first (the interface). ``function`` and ``equation`` are the two ways to define h. ``stack`` evaluates
many barriers at once, with ``cache`` for repeated states. Ready-made are ``limits``, ``stopping``, ``higher_order`` and
``rollout`` (with ``backup_rollout`` and ``path_minimum``).
"""
