"""Writes ``written_steps.py`` next to it: ``python -m safedpa.dynamics.write_steps``; ``--check`` only compares.

What recording the shipped models gives stands in a module of its own, so that it is compiled with the rest. A step of
the car takes 1.5 us as Python's own code and a fifth of that compiled; a robot-tick has about seventeen.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping
from pathlib import Path

from safedpa.dynamics import load_model, shipped_models
from safedpa.dynamics.straight import step_texts
from safedpa.dynamics.tangent import written_key

__all__ = ["main", "text"]

_PATH = Path(__file__).with_name("written_steps.py")
_WRITER = "safedpa.dynamics.write_steps"
_SLOW, _QUICKER = 0.05, (0.01, 0.005)
"""s; periods in which robots that are as slow may drive as well: the steps of their own models are written for both."""
_FUNCTIONS = ("atan", "atan2", "cos", "cosh", "exp", "hypot", "inf", "nan", "sin", "sqrt", "tan", "tanh")
_VECTOR = "Iterable[float]"
_RESULTS = {"step": "list[float]", "tangent": "tuple[list[float], list[list[float]]]"}
_MESSAGE = {"step": "Entries after one period.", "tangent": "The same, and their slopes in the action."}


def text() -> str:
    """What stands in the module: step and tangent of every shipped model without networks, over its own period."""
    found: dict[str, tuple[str, str]] = {}
    for model_name in shipped_models():
        model = load_model(model_name)
        slow = model_name == model.system.name and model.period >= _SLOW
        for period in (model.period, *(_QUICKER if slow else ())):
            name = model_name if period == model.period else f"{model_name}_{round(1.0 / period)}_hz"
            system, equations = model.system, model.equations(period)
            recorded = step_texts(equations, system.state_names, system.action_names, model.latent_names) or ()
            for kind, function in zip(_RESULTS, recorded, strict=False):
                found.setdefault(written_key(function), (f"{name}_{kind}", _typed(function, kind, name)))
    return _module(found)


def _typed(recorded: str, kind: str, name: str) -> str:
    """The recorded function under a name of its own, with the types of its arguments and of what comes out."""
    head, body = recorded.split("\n", 1)
    del head
    arguments = f"state: {_VECTOR}, action: {_VECTOR}, latent: {_VECTOR}, time: float"
    return f'def {name}_{kind}({arguments}) -> {_RESULTS[kind]}:\n    """{_MESSAGE[kind]}"""\n{body}\n'


def _module(written: Mapping[str, tuple[str, str]]) -> str:
    functions = "\n\n".join(function for _, function in written.values())
    used = [name for name in _FUNCTIONS if re.search(rf"\b{name}\b", functions)]
    keys = "\n".join(f'    "{key}": {name},' for key, (name, _) in written.items())
    names = ", ".join(f'"{name}"' for name in ["WRITTEN", *sorted(name for name, _ in written.values())])
    return "\n".join(
        [
            f'"""Steps of the shipped models as recorded; written by ``{_WRITER}``, not by hand."""',
            "",
            "from __future__ import annotations",
            "",
            "from collections.abc import Iterable",
            f"from math import {', '.join(used)}",
            "from typing import Any",
            "",
            f"__all__ = [{names}]",
            "",
            "",
            functions,
            "",
            "WRITTEN: dict[str, Any] = {",
            keys,
            "}",
            '"""By what was recorded: ``safedpa.dynamics.tangent.written_key``."""',
            "",
        ]
    )


def main() -> int:
    """Writes or compares; what differs is the exit code."""
    if "--check" in sys.argv[1:]:
        return int(_PATH.read_text(encoding="utf-8") != text())
    _PATH.write_text(text(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
