"""What a model knows, for other simulators: their own files where they can say it, and what they cannot, by name."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from safedpa.dynamics.physics import PhysicsModel

__all__ = ["SimulatorExport", "export_table"]


@dataclass(frozen=True)
class SimulatorExport:
    """A model in other simulators' words."""

    documents: Mapping[str, str] = field(default_factory=dict)
    """Text of each file, by name: ``pendulum.mjcf.xml``, say."""
    unexpressed: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    """By file: the effects that its simulator cannot say, and why or what to do instead."""


def export_table(model: PhysicsModel, other: SimulatorExport | None = None) -> str:
    """Every parameter with unit and equation, and what could not be said elsewhere, as JSON."""
    found: dict[str, Any] = {
        "format": 1,
        "robot": model.system.name,
        "period": model.period,
        "base": {"kind": model.base.kind, "equation": model.base.equation, "parameters": _values(model, "base")},
        "effects": [
            {"name": item.name, "equation": item.equation, "parameters": _values(model, item.name)}
            for item in model.effects
        ],
        "unexpressed": {} if other is None else {name: dict(why) for name, why in other.unexpressed.items()},
    }
    return json.dumps(found, indent=2, allow_nan=False) + "\n"


def _values(model: PhysicsModel, prefix: str) -> dict[str, dict[str, Any]]:
    return {
        path.partition(".")[2]: {"value": model.settings[path].value, "unit": parameter.unit}
        for path, parameter in model.parameters.items()
        if path.partition(".")[0] == prefix
    }
