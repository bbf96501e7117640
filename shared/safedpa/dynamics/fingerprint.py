"""Which model is meant: a short hash of everything that decides its predictions."""

from __future__ import annotations

from hashlib import sha256

from safedpa.dynamics.model_file import write_model
from safedpa.dynamics.physics import PhysicsModel

__all__ = ["fingerprint"]


def fingerprint(model: PhysicsModel) -> str:
    """Twelve hexadecimal digits of the SHA-256 of the model file's text."""
    return sha256(write_model(model).encode()).hexdigest()[:12]
