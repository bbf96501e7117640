"""The error of a place without finite slopes; in a module of its own, since no compiled one may define it.

mypyc lays out a class by its bases, and knows those of other modules not at all: an exception of such a base had the
memory of something else for its words, and the process ended with it.
"""

from __future__ import annotations

from typing import final

from safedpa.errors import InputError

__all__ = ["NotFiniteError"]


@final
class NotFiniteError(InputError):
    """Model or barrier have no finite slopes there: no tangent, though there may be one elsewhere."""
