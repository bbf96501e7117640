"""The optimisation that chooses an action.

Read ``constraints`` first (the CBF constraints of one tick), then ``sqp`` (the nearest feasible action) and
``least_violation`` (no action is feasible). ``linearization`` and ``candidates`` serve both. ``qp``, ``qp_scaling``,
``active_set_2d`` and ``maximin_lp`` solve the programs that arise.
"""
