"""The simulated pendulum: ``world`` is the physics, ``robot`` the robot that services see, with its tasks."""
