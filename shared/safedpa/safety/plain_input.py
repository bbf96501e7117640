"""What the check of an input asks of every entry, over plain numbers."""

from __future__ import annotations

from typing import Final

__all__ = ["BELIEVED", "NOT_FINITE", "first_unbelieved"]

BELIEVED: Final = -1
"""All entries are finite and within their range."""
NOT_FINITE: Final = -2
"""One of them is NaN or infinite."""


def first_unbelieved(entries: tuple[float, ...], low: tuple[float, ...], high: tuple[float, ...]) -> int:
    """The place of the first entry outside ``low`` to ``high`` (none, or as many), or what stands above."""
    for value in entries:
        if value - value != 0.0:
            return NOT_FINITE
    for index in range(len(low)):
        value = entries[index]
        if value < low[index] or value > high[index]:
            return index
    return BELIEVED
