"""The paper's inverted pendulum in the wind: what is asked of it, and its barrier."""
