"""Adaptation: online estimation of the model's latent parameters from the last transitions of a robot.

``abstract`` is the interface of an estimator; ``estimator`` is an extended Kalman filter for physical parameters,
``history_estimator`` a learned encoder, ``batch_history_estimator`` its version for many robots. ``node`` is the
service. Read ``estimator.py`` first.
"""

from safedpa.adaptation.abstract import AbstractEstimator
from safedpa.adaptation.estimator import EstimatorSettings, LatentEstimator
from safedpa.adaptation.history_estimator import HistoryEstimator
from safedpa.adaptation.node import AdaptationNode

__all__ = ["AbstractEstimator", "AdaptationNode", "EstimatorSettings", "HistoryEstimator", "LatentEstimator"]
