"""The model with which a process begins, as it says it on the bus."""

from __future__ import annotations

from dataclasses import replace

from safedpa.bus import SetupMessage
from safedpa.dynamics.fingerprint import fingerprint
from safedpa.dynamics.model_file import write_model
from safedpa.dynamics.physics import PhysicsModel

__all__ = ["model_setup"]


def model_setup(setup: SetupMessage, model: PhysicsModel) -> SetupMessage:
    """The setup of a process that begins with a model."""
    return replace(setup, fingerprint=fingerprint(model), document=write_model(model))
