"""Optional packages by the name of the extra that installs them.

The core has the library, the filter, the services of the control loop and the command line. Everything else is an
extra, as in ``pip install 'safedpa[sim,view]'``. Commands check for missing extras before they begin.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator
from functools import wraps
from typing import Any, TypeVar

from safedpa.errors import InputError, MissingExtraError

__all__ = ["EXTRAS", "INCLUDED", "extra_of", "missing", "need", "need_linux", "need_module", "needs"]

Function = TypeVar("Function", bound=Callable[..., Any])

EXTRAS: dict[str, tuple[str, ...]] = {
    "sim": ("pymunk", "scipy"),
    "view": ("rerun", "httpx", "starlette", "uvicorn"),
    "diagnosis": ("pyarrow", "jinja2", "plotly", "rerun"),
    "notebook": ("ipywidgets", "matplotlib", "pandas"),
    "workbench": ("nicegui",),
    "train": ("torch", "gymnasium", "matplotlib", "mujoco", "onnx", "onnxruntime", "sb3_contrib", "stable_baselines3"),
    "metrics": ("prometheus_client", "starlette", "uvicorn"),
    "cluster": ("ray",),
    "gym": ("gymnasium",),
    "ros": ("rosbags", "pyulog"),
    "hdf5": ("h5py",),
    "remote": ("fsspec", "aiohttp"),
}
"""Modules that each extra installs."""

INCLUDED: dict[str, tuple[str, ...]] = {"workbench": ("diagnosis",), "train": ("sim", "diagnosis")}
"""Extras that another extra includes."""


def missing(extra: str, *, alone: bool = False) -> tuple[str, ...]:
    """Returns the missing modules of an extra and, unless ``alone``, of the extras that it includes.

    Does not import them.
    """
    names = EXTRAS[extra] if alone else _modules(extra)
    return tuple(name for name in names if importlib.util.find_spec(name) is None)


def need_linux(what: str) -> None:
    """Raises InputError on a system without the modules of POSIX, where the library works but services do not."""
    lacking = [name for name in ("fcntl", "resource") if importlib.util.find_spec(name) is None]
    if lacking:
        raise InputError(
            f"{what} needs Linux; this system has no {' and no '.join(lacking)}: use a container or WSL; the library "
            "(filter, comparison, diagnosis) works here"
        )


def need(*extras: str, what: str = "this", instead: str = "", alone: bool = False) -> None:
    """Raises MissingExtraError if a module of the extras is missing; ``alone`` ignores the extras that they include.

    ``what`` names the feature that needs them, ``instead`` an alternative.
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
    """Decorator of a command that calls ``need(*extras)`` first."""

    def decorated(function: Function) -> Function:
        @wraps(function)
        def checked(*arguments: Any, **options: Any) -> Any:
            need(*extras)
            return function(*arguments, **options)

        return checked  # type: ignore[return-value]

    return decorated


def need_module(module: str, what: str) -> None:
    """Raises MissingExtraError if one module is missing, for a feature that needs it alone of its extra."""
    if importlib.util.find_spec(module) is None:
        raise MissingExtraError(f"{what} needs pip install 'safedpa[{extra_of(module)}]'; not installed: {module}")


def extra_of(module: str) -> str | None:
    """Returns the first extra that installs a module or its top-level package; None without one."""
    top = module.split(".", 1)[0]
    return next((extra for extra, modules in EXTRAS.items() if top in modules), None)


def _modules(extra: str) -> Iterator[str]:
    for included in INCLUDED.get(extra, ()):
        yield from _modules(included)
    yield from EXTRAS[extra]
