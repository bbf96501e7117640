"""Recorded equations that stand in a module of their own, so that they are compiled with the rest, by their text."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from hashlib import blake2b
from typing import Any

from safedpa.dynamics.written_steps import WRITTEN

__all__ = ["written", "written_key"]


def written(text: str, calls: Mapping[str, Callable[..., Any]]) -> Any:
    """The function with just this text, which does the same to the last bit; None where there is none.

    Nor is there for a text that has ``calls``: what is called is not known from it.
    """
    return None if calls else WRITTEN.get(written_key(text))


def written_key(text: str) -> str:
    """BLAKE2b of the text in UTF-8, 16 bytes, as hexadecimal digits."""
    return blake2b(text.encode(), digest_size=16).hexdigest()
