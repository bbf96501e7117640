"""Shared by the experiments: seeds, statistics, processes and drives that are kept, and the style of the figures."""
