"""Controllers of the car; read ``goal_seeker`` first.

``goal_seeker`` drives to the goal and ignores obstacles. ``route_follower`` plans around what perception reports, with
costs from ``route_cost`` and the value function of ``time_to_goal``; ``mppi`` is a sampling-based planner.
"""
