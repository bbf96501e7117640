"""Finds functions that the build generated from recorded equations.

``python -m safedpa.generate`` writes the modules. Each lists its functions in ``GENERATED``, under the digest of what
was recorded: an equation that changed after the generation has another digest, so an outdated function is never used.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from hashlib import blake2b
from importlib import import_module
from typing import Any


def digest(recorded: str) -> str:
    """The BLAKE2b digest (16 bytes, hexadecimal) of recorded equations as text in UTF-8."""
    return blake2b(recorded.encode(), digest_size=16).hexdigest()


@cache
def generated(module: str) -> Mapping[str, Any]:
    """The functions and classes of a generated module by digest.

    Empty where the module was not generated: the caller then records the equations itself, with the same results.
    """
    try:
        found: Mapping[str, Any] = import_module(module).GENERATED
    except ModuleNotFoundError as error:
        # a module that exists but cannot import something is broken, and must not be taken for one that is missing
        if error.name != module:
            raise
        return {}
    return found
