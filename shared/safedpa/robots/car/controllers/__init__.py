"""Controllers of the car: goal seeker, route follower and MPPI planner."""
