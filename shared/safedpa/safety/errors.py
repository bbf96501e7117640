"""The error of a point without finite derivatives; in a module of its own, since a compiled module may not define it.

mypyc lays out a class in memory by its bases, and does not know the layout of a base in another module: an exception
defined there corrupted memory and crashed the process.
"""

from __future__ import annotations

from typing import final

from safedpa.errors import InputError

__all__ = ["NotFiniteError"]


@final
class NotFiniteError(InputError):
    """Model or barrier have no finite derivatives at this point; they may have them elsewhere."""
