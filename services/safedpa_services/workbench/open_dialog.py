"""The dialog that chooses model and recordings (stub to be completed)."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

from safedpa_services.workbench.recordings import Choice

__all__ = ["OpenDialog"]


class OpenDialog:
    """x"""

    def __init__(self, on_open: Callable[[Choice], Awaitable[None]]) -> None:
        self.is_open = False

    def show(self, choice: Choice) -> None:
        """x"""
