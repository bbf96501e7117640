"""Generates the modules of recorded equations: ``python -m safedpa.generate [FOLDER]``.

``make environment`` and the build of a wheel run it. Without a FOLDER the files are written next to the sources that
they are generated from. The same sources give the same bytes.
"""

from __future__ import annotations

import sys
from pathlib import Path

from safedpa.disk import write_through
from safedpa.dynamics import generate_steps
from safedpa.robots.car import generate_barriers

__all__ = ["GENERATORS", "generate"]

GENERATORS = {
    "safedpa.dynamics.generated_steps": generate_steps.source,
    "safedpa.robots.car.generated_barriers": generate_barriers.source,
}
"""What returns the text of each generated module."""


def generate(folder: Path) -> list[Path]:
    """Writes all generated modules below ``folder``, and returns their paths; files that are up to date stay untouched.

    Raises OSError where a file cannot be written.
    """
    paths = []
    for module, source in GENERATORS.items():
        path = folder.joinpath(*module.split(".")).with_suffix(".py")
        text = source()
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_through(path, text)
        paths.append(path)
    return paths


if __name__ == "__main__":
    generate(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parents[1])
