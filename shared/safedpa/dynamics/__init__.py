"""Models: a base (known physics), a list of named effects, and the TOML files that describe them.

Read ``dynamics`` first (the interface that the filter uses), then ``physics`` (a base with effects), ``model_file``
(reading and writing), ``recorded_step`` and ``tangent`` (the fast functions for one robot). ``generate_steps`` writes
the module that the build compiles.
"""

from safedpa.dynamics.base import AbstractBase
from safedpa.dynamics.dynamics import AbstractDynamics
from safedpa.dynamics.learned_base import LearnedBase
from safedpa.dynamics.model_file import fingerprint, load_model, parse_model, save_model, shipped_models, write_model
from safedpa.dynamics.physics import PhysicsModel
from safedpa.dynamics.settings import Setting
from safedpa.dynamics.user_files import load_user_file, load_user_file_everywhere

__all__ = [
    "AbstractBase",
    "AbstractDynamics",
    "LearnedBase",
    "PhysicsModel",
    "Setting",
    "fingerprint",
    "load_model",
    "load_user_file",
    "load_user_file_everywhere",
    "parse_model",
    "save_model",
    "shipped_models",
    "write_model",
]
