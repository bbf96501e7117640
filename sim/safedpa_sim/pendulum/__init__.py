"""The paper's inverted pendulum in the wind: what is asked of it, its barrier, and the experiments on it."""
