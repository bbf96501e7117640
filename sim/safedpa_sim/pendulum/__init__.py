"""The paper's inverted pendulum in the wind; read ``task`` (constants, barrier), then ``policy_task`` (training)."""
