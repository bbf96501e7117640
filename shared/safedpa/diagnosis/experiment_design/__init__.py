"""Experiment design: which manoeuvre would separate models that the recordings cannot tell apart.

``choice`` is the only module: it simulates a fixed list of manoeuvres with each model and returns the one for which the
predictions differ most, in units of the measurement noise.
"""
