"""Variants of tuning on real data that the laboratory compares with phase 3; read ``predictors`` first.

``predictors`` gives all models one interface for prediction. ``paper`` tunes as the paper describes it, ``online``
while the robot drives. ``residual_networks`` learns what corrected physics leaves. ``reference_point`` moves a model to
another point of the car.
"""
