"""The program that chooses an action.

Read ``constraints`` first (the CBF constraints of one tick), then ``sqp`` (the nearest feasible action) and
``least_violation`` (no action is feasible). ``qp``, ``active_set_2d`` and ``maximin_lp`` solve the programs that arise.
"""
