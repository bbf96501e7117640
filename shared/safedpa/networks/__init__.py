"""Learned networks at work: weights on disk, and inference in plain numpy, for one robot or many."""

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
