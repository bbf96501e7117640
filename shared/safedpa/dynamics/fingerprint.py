"""The fingerprint of a model: a short hash of everything that its predictions depend on."""

from __future__ import annotations

import json
from hashlib import sha256

from safedpa.dynamics.model_file import write_model
from safedpa.dynamics.physics import PhysicsModel
from safedpa.limits import parse_toml

__all__ = ["fingerprint"]


def fingerprint(model: PhysicsModel) -> str:
    """Returns twelve hexadecimal digits of the SHA-256 over the model file's keys and values, without comments.

    Learned networks count by the digest of their weights, not by the name of the weights' file.
    """
    # through the text: two models are the same if their files say the same, however they were constructed
    table = parse_toml(write_model(model))
    table.get("networks", {}).pop("weights", None)
    # sorted keys: the order in a file does not matter; the order of effects does, and lists keep theirs
    return sha256(json.dumps(table, sort_keys=True).encode()).hexdigest()[:12]
