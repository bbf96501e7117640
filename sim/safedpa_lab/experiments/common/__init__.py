"""Shared by the experiments: drives through the real nodes, seeds, statistics, processes, and the style of figures."""
