"""Writes ``written_steps.py`` beside it: ``python -m safedpa.robots.car.write_steps``; ``--check`` only compares.

One step of the shipped car and its slopes, as recording them gives: filter, adaptation and policy take some fifteen of
them in a tick. A car with other numbers or effects is recorded when it is first asked for, and computes the same.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping
from pathlib import Path

from safedpa.dynamics import PhysicsModel, load_model
from safedpa.dynamics.written_ahead import text_key

__all__ = ["main", "text", "written_steps"]

_FUNCTIONS = ("atan", "cos", "cosh", "exp", "hypot", "inf", "nan", "sin", "sqrt", "tan", "tanh")
_ARGUMENTS = "state: Sequence[float], action: Sequence[float], latent: Sequence[float], time: float"
_STEP = "list[float]"
_TANGENT = "tuple[list[float], list[list[float]]]"
_KINDS = (
    ("step", _STEP, "The state's entries after one period."),
    ("tangent", _TANGENT, "The same, and their slopes in the action."),
    ("sensitivity", _TANGENT, "The same, and their slopes in state and action."),
)
_PATH = Path(__file__).with_name("written_steps.py")


def text() -> str:
    """What stands in the module."""
    models = {name: load_model(name) for name in ("car", "car_measured")}
    return written_steps("Steps of the shipped cars as recorded", "safedpa.robots.car.write_steps", models)


def written_steps(subject: str, writer: str, models: Mapping[str, PhysicsModel]) -> str:
    """The text of the module, for models by name; each must be arithmetic alone. Raises ValueError where one is not."""
    functions, keys, names = list[str](), list[str](), ["WRITTEN"]
    for name, model in models.items():
        texts = model.straight_texts()
        if not texts or any("complex" in text or "**" in text for text in texts):
            raise ValueError(f"{name}: got equations that are no plain arithmetic; leave the model out")
        for text, (kind, result, words) in zip(texts, _KINDS, strict=True):
            if kind == "sensitivity" and model.straight_sensitivity is None:
                continue
            _, body = text.split("\n", 1)
            functions += ["", "", f"def {name}_{kind}({_ARGUMENTS}) -> {result}:", f'    """{words}"""', body]
            keys.append(f'    "{text_key(text)}": {name}_{kind},')
            names.append(f"{name}_{kind}")
    whole = "\n".join(functions)
    used = [name for name in _FUNCTIONS if re.search(rf"\b{name}\b", whole)]
    head = [
        f'"""{subject}; written by ``{writer}``, not by hand."""',
        "",
        "from __future__ import annotations",
        "",
        "from collections.abc import Callable, Sequence",
        f"from math import {', '.join(used)}",
        "from typing import Any",
        "",
        "__all__ = [" + ", ".join(f'"{name}"' for name in sorted(names)) + "]",
    ]
    tail = ["", "", "WRITTEN: dict[str, Callable[..., Any]] = {", *keys, "}", '"""By what was recorded."""', ""]
    return "\n".join([*head, whole, *tail])


def main() -> int:
    """Writes or compares; what differs is the exit code."""
    if "--check" in sys.argv[1:]:
        return int(_PATH.read_text(encoding="utf-8") != text())
    _PATH.write_text(text(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
