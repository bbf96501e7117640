"""Barriers h >= 0 define the safe set.

Read ``base`` first (the interface). ``function`` and ``equation`` are the two ways to define h. ``stack`` evaluates
many barriers at once, with ``cache`` for repeated states. Ready-made are ``limits``, ``stopping``, ``higher_order``,
``look_ahead``, ``distance_field`` and ``rollout`` (with ``backup_rollout`` and ``path_minimum``); ``between_ticks``
adds a bound of h between two ticks to any of them.
"""
