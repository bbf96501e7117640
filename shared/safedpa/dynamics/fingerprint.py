"""Which model is meant: a short hash of everything that decides its predictions, and of nothing else."""

from __future__ import annotations

import json
from hashlib import sha256

from safedpa.dynamics.model_file import write_model
from safedpa.dynamics.physics import PhysicsModel
from safedpa.limits import parse_toml

__all__ = ["fingerprint"]


def fingerprint(model: PhysicsModel) -> str:
    """Twelve hexadecimal digits of the SHA-256 over the model file's keys and values, its comments left out.

    Of learned networks the numbers count, by their digest, not the name of the file that they are in.
    """
    table = parse_toml(write_model(model))
    table.get("networks", {}).pop("weights", None)
    return sha256(json.dumps(table, sort_keys=True).encode()).hexdigest()[:12]
