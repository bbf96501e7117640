"""The simulated pendulum: ``world`` is the physics, ``task`` the scenario, ``robot`` the robot that services see."""
