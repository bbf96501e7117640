"""What the model predicts: the next state, and the state at which a delayed action takes effect.

Read ``predictor`` first (the model as the filter uses it), then ``dead_time`` (where an action takes effect).
``command_history`` has the commands in flight, ``delay_estimator`` finds an unreported delay, and ``delayed_model``
puts pending actions into the state of a user's model.
"""
