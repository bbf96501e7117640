"""Inference of learned networks in NumPy, for one robot or many, and their weights on disk.

Read ``weights`` first (the file and its description), then ``frame`` (inputs and the robot's own frame),
``learned_networks`` (f, g and mu), ``history`` and ``stream`` (the history encoder phi). ``tensors`` and ``reference``
are the same networks in torch, for fits and tests.
"""

from safedpa.networks.frame import Frame, frame_of
from safedpa.networks.history import HistoryEncoder
from safedpa.networks.layers import Layer, convolution_stack, dense_stack
from safedpa.networks.learned_networks import LearnedNetworks
from safedpa.networks.stream import HistoryStreams
from safedpa.networks.weights import Description, EnvironmentEntry, Weights, load_weights, save_weights

__all__ = [
    "Description",
    "EnvironmentEntry",
    "Frame",
    "HistoryEncoder",
    "HistoryStreams",
    "Layer",
    "LearnedNetworks",
    "Weights",
    "convolution_stack",
    "dense_stack",
    "frame_of",
    "load_weights",
    "save_weights",
]
