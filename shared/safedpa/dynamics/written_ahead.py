"""Straight-line functions of shipped models that stand in a module of their own, where they can be compiled."""

from __future__ import annotations

from collections.abc import Callable
from hashlib import blake2b
from importlib import import_module
from typing import Any

__all__ = ["text_key", "written_ahead"]


def written_ahead(module: str, text: str) -> Callable[..., Any] | None:
    """The function that ``module`` holds for what was recorded; None: make it now.

    The text holds every number of the model: a model with other numbers, effects or period has another one.
    """
    if not module:
        return None
    known: dict[str, Callable[..., Any]] = import_module(module).WRITTEN
    return known.get(text_key(text))


def text_key(text: str) -> str:
    """The name under which a function stands there."""
    return blake2b(text.encode(), digest_size=16).hexdigest()
