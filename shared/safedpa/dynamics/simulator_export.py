"""Export of a model to other simulators: their own files, and the effects that these cannot express."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from safedpa.dynamics.physics import PhysicsModel


@dataclass(frozen=True)
class SimulatorExport:
    """A model as files of other simulators."""

    documents: Mapping[str, str] = field(default_factory=dict)
    """Text of each file, by name, such as ``pendulum.mjcf.xml``."""
    unexpressed: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    """By file, then by effect: why its simulator cannot express the effect, or what to do instead."""


def export_table(model: PhysicsModel, other: SimulatorExport | None = None) -> str:
    """Returns every parameter with unit and equation, and the effects that ``other`` cannot express, as JSON."""
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
    # NaN is no JSON: a reader in another language would fail far from here
    return json.dumps(found, indent=2, allow_nan=False) + "\n"


def _values(model: PhysicsModel, prefix: str) -> dict[str, dict[str, Any]]:
    return {
        path.partition(".")[2]: {"value": model.settings[path].value, "unit": parameter.unit}
        for path, parameter in model.parameters.items()
        if path.partition(".")[0] == prefix
    }
