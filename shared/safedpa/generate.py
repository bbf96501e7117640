"""Compiles the decisions of the shipped robots: ``python -m safedpa.generate [FOLDER]``.

``make environment`` and the build of a wheel run it. Without a FOLDER the compiled files go to the user's cache.
Without a C compiler it says so in one line: the same decisions are then computed by Python.
"""

from __future__ import annotations

import sys
from pathlib import Path

from safedpa.dynamics import shipped_steps
from safedpa.native import NoKernelError
from safedpa.native.library import build_into, load, load_module
from safedpa.networks.compiled import frame_sources
from safedpa.robots.car import shipped_rows as car_rows
from safedpa.robots.differential_drive import shipped_rows as wheeled_rows
from safedpa.robots.pendulum import shipped_rows as pendulum_rows

__all__ = ["generate", "shipped_sources"]


def shipped_sources() -> list[str]:
    """The C of every shipped model, of the inputs of networks, and of the barriers of the shipped robots."""
    return [
        *shipped_steps.sources(),
        *frame_sources(),
        *car_rows.sources(),
        *wheeled_rows.sources(),
        *pendulum_rows.sources(),
    ]


def generate(folder: Path | None = None) -> None:
    """Compiles into a folder, or what is missing in the user's cache. Raises NoKernelError where it is not possible."""
    if folder is not None:
        build_into(folder, shipped_sources())
        return
    load_module()
    for source in shipped_sources():
        load(source)


if __name__ == "__main__":
    try:
        generate(Path(sys.argv[1]) if len(sys.argv) > 1 else None)
    except NoKernelError as error:
        sys.exit(f"safedpa: decisions are not compiled: {error}")
