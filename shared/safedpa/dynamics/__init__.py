"""Models: known physics, composed with effects, in files that people can read."""

from safedpa.dynamics.base import AbstractBase
from safedpa.dynamics.dynamics import AbstractDynamics
from safedpa.dynamics.fingerprint import fingerprint
from safedpa.dynamics.learned_base import LearnedBase
from safedpa.dynamics.model_file import load_model, parse_model, save_model, shipped_models, write_model
from safedpa.dynamics.own import load_own, load_own_everywhere
from safedpa.dynamics.physics import PhysicsModel, Setting

__all__ = [
    "AbstractBase",
    "AbstractDynamics",
    "LearnedBase",
    "PhysicsModel",
    "Setting",
    "fingerprint",
    "load_model",
    "load_own",
    "load_own_everywhere",
    "parse_model",
    "save_model",
    "shipped_models",
    "write_model",
]
