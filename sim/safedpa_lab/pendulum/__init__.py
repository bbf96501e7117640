"""The pendulum's experiments: methods, recovery, invariance, both questions, its margin.

``methods`` lists what is compared, ``rollouts`` swings many pendulums in the closed loop, ``questions`` are the paper's
two. Read ``methods`` first.
"""
