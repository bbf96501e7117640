"""The setup message of a process that starts with a model."""

from __future__ import annotations

from dataclasses import replace

from safedpa.bus import SetupMessage
from safedpa.dynamics.fingerprint import fingerprint
from safedpa.dynamics.model_file import write_model
from safedpa.dynamics.physics import PhysicsModel

__all__ = ["model_setup"]


def model_setup(setup: SetupMessage, model: PhysicsModel) -> SetupMessage:
    """Returns ``setup`` with the model's fingerprint and document."""
    return replace(setup, fingerprint=fingerprint(model), document=write_model(model))
