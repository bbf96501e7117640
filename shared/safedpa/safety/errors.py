"""Errors within one decision."""

from __future__ import annotations

from typing import final

from safedpa.errors import InputError

__all__ = ["NotFiniteError", "OutOfBudgetError"]


@final
class NotFiniteError(InputError):
    """Model or barrier have no finite derivatives at this point; they may have them elsewhere."""


@final
class OutOfBudgetError(Exception):
    """The decision has used up its time or its evaluations; the best candidate so far is taken."""
