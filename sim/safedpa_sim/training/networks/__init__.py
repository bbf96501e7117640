"""The networks during training; read ``modules`` first.

``modules`` holds mu, f, g and phi as torch modules. ``rollout`` computes their prediction errors over one and many
steps, ``explained_variance`` the share of the variance that they explain.
"""
