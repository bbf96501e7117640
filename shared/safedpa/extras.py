"""What a plain ``pip install safedpa`` leaves out, by the name of the extra that brings it.

The core holds the library, the filter, the services of a loop and the command line. Everything else is asked for by
name, ``pip install 'safedpa[sim,view]'``, and what is missing is said in one line before any work begins.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator
from functools import wraps
from typing import Any, TypeVar

from safedpa.errors import MissingExtraError

__all__ = ["EXTRAS", "INCLUDED", "extra_of", "missing", "need", "needs"]

Function = TypeVar("Function", bound=Callable[..., Any])

EXTRAS: dict[str, tuple[str, ...]] = {
    "sim": ("pymunk", "scipy"),
    "view": ("rerun",),
    "diagnosis": ("pyarrow", "jinja2", "plotly", "rerun"),
    "workbench": ("nicegui",),
    "train": ("torch", "gymnasium", "matplotlib", "mujoco", "onnx", "onnxruntime", "sb3_contrib", "stable_baselines3"),
    "metrics": ("prometheus_client",),
    "cluster": ("ray",),
    "gym": ("gymnasium",),
    "ros": ("rosbags", "pyulog"),
}
"""Modules that each extra brings by itself."""

INCLUDED: dict[str, tuple[str, ...]] = {"workbench": ("diagnosis",), "train": ("sim", "diagnosis")}
"""Extras that another one brings along."""


def missing(extra: str, *, alone: bool = False) -> tuple[str, ...]:
    """The modules of an extra that cannot be found; unless ``alone``, of those that it includes, too.

    Nothing is imported.
    """
    names = EXTRAS[extra] if alone else _modules(extra)
    return tuple(name for name in names if importlib.util.find_spec(name) is None)


def need(*extras: str, what: str = "this", instead: str = "", alone: bool = False) -> None:
    """Returns where every module of the extras is there; ``alone``: whatever they include besides is not asked for.

    ``what`` says what needs them, ``instead`` how to go on without. Raises MissingExtraError, one line that names them.
    """
    lacking = {extra: missing(extra, alone=alone) for extra in extras}
    wanted = [extra for extra, modules in lacking.items() if modules]
    if wanted:
        names = ", ".join(dict.fromkeys(name for modules in lacking.values() for name in modules))
        without = f", or {instead}" if instead else ""
        raise MissingExtraError(
            f"{what} needs pip install 'safedpa[{','.join(wanted)}]'{without}; not installed: {names}"
        )


def needs(*extras: str) -> Callable[[Function], Function]:
    """Decorates a command: its first line is ``need(*extras)``."""

    def decorated(function: Function) -> Function:
        @wraps(function)
        def checked(*arguments: Any, **options: Any) -> Any:
            need(*extras)
            return function(*arguments, **options)

        return checked  # type: ignore[return-value]

    return decorated


def extra_of(module: str) -> str | None:
    """The first extra that brings a module, or a part of it; None where no extra does."""
    top = module.split(".", 1)[0]
    return next((extra for extra, modules in EXTRAS.items() if top in modules), None)


def _modules(extra: str) -> Iterator[str]:
    for included in INCLUDED.get(extra, ()):
        yield from _modules(included)
    yield from EXTRAS[extra]
