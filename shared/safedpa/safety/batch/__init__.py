"""The filter for many robots at once, for simulation, training and evaluation.

Read ``filter`` first, then ``constraints`` (the SQP over arrays). ``barriers`` and ``predictor`` supply h and the next
states, and ``active_set_2d`` solves the quadratic programs.
"""
