"""Writes ``written_barriers.py`` next to it: ``python -m safedpa.robots.car.generate_barriers``.

``--check`` only compares.

What recording the car's barriers gives stands in a module of its own, so that it is compiled with the rest and no
service has to record anything when it starts.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping
from pathlib import Path

from safedpa.equations.plain_rows import plain_class
from safedpa.equations.rows import RowTape
from safedpa.robots.car.barriers.moving_obstacles import MovingObstacleBarrier
from safedpa.robots.car.barriers.obstacles import FieldBarrier, ObstacleBarrier
from safedpa.robots.car.barriers.trailer import TrailerEnvelope
from safedpa.robots.car.dynamics.limits import ReversalBraking
from safedpa.safety.barriers.equation import AbstractEquationBarrier, pattern_of, tape_of, written_key
from safedpa.safety.barriers.limits import SpeedBarrier
from safedpa.safety.barriers.stopping import Braking

__all__ = ["main", "text", "written_module"]

_FUNCTIONS = ("atan", "cos", "exp", "hypot", "sin", "sqrt", "tan", "tanh")


def written_module(subject: str, writer: str, found: Mapping[str, tuple[str, RowTape]]) -> str:
    """``found``: by the name of its class the key of a pattern, and its tape."""
    classes = [plain_class(tape, name) for name, (_, tape) in found.items()]
    used = [name for name in _FUNCTIONS if re.search(rf"\b{name}\(", "\n".join(classes))]
    keys = "\n".join(f'    "{key}": {name},' for name, (key, _) in found.items())
    names = ", ".join(f'"{name}"' for name in ["WRITTEN", *sorted(found)])
    return "\n".join(
        [
            f'"""{subject}; written by ``{writer}``, not by hand."""',
            "",
            "from __future__ import annotations",
            "",
            "from collections.abc import Sequence",
            f"from math import {', '.join(used)}",
            "from typing import Any, final",
            "",
            "from safedpa.equations.chain_rule import chain_rule",
            "",
            f"__all__ = [{names}]",
            "",
            "",
            "\n\n".join(f"{text}" for text in classes),
            "",
            "WRITTEN: dict[str, Any] = {",
            keys,
            "}",
            '"""By what was recorded."""',
            "",
        ]
    )


_PATH = Path(__file__).with_name("written_barriers.py")
_WRITER = "safedpa.robots.car.generate_barriers"
_BODY = (0.1, 0.4, 0.1)
_FIELD = (-1.0, 1.0, -1.0, 1.0)
_STATES = 4


def text() -> str:
    """What stands in the module: obstacles and speed, with and without walls and something towed; what sensors
    see, and of that each kind by itself."""
    found = {}
    for name, towed in (("", None), ("Towing", TrailerEnvelope(0.1, 0.5, 0.2, 0.0, (0.0, 0.0, 0.0)))):
        braking = Braking(2.0, 2.5)
        obstacles = ObstacleBarrier((), _BODY, braking, towed=towed)
        field = FieldBarrier(_FIELD, _BODY, braking, towed=towed)
        speed = SpeedBarrier(-1.0, 1.0)
        counter = ReversalBraking(2.0, 2.5, 0.6)
        movers = MovingObstacleBarrier((), (), _BODY, braking, counter, towed=towed)
        sets: tuple[tuple[str, tuple[AbstractEquationBarrier, ...]], ...] = (
            ("Open", (obstacles, speed)),
            ("Walled", (obstacles, field, speed)),
            ("Sensed", (obstacles, movers, speed)),
            ("Still", (obstacles,)),
            ("Moving", (movers,)),
        )
        for room, parts in sets:
            pattern = pattern_of(parts)
            found[f"{room}{name}"] = written_key(pattern, _STATES), tape_of(pattern, _STATES)
    return written_module("The car's barriers as recorded from ``barriers.py``", _WRITER, found)


def main() -> int:
    """Writes or compares; what differs is the exit code."""
    if "--check" in sys.argv[1:]:
        return int(_PATH.read_text(encoding="utf-8") != text())
    _PATH.write_text(text(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
