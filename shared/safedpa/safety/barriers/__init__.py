"""Barriers h >= 0: how a safe set is written down.

Read ``base`` first. ``function`` and ``equation`` are the two ways to write h; ``stack`` evaluates many at once.
``limits``, ``stopping``, ``rollout`` and ``higher_order`` are ready-made.
"""
