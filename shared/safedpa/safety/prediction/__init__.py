"""What the model predicts: the next state, and the state at which a delayed action takes effect.

Read ``predictor`` first, then ``dead_time``.
"""
