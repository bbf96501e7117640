"""The networks during training; read ``modules`` first.

``modules`` holds mu, f, g and phi as torch modules. ``prediction_errors`` computes their errors over one and many
steps, and the share of the variance that they explain.
"""
