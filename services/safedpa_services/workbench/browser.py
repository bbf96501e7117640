"""What a browser is asked. A tab that was closed meanwhile, or that is too busy to answer, is no error."""

from __future__ import annotations

from typing import Any

from nicegui import ui

__all__ = ["answer_of", "prefers_dark"]

_SECONDS = 5.0


async def answer_of(script: str, seconds: float = _SECONDS) -> Any:
    """What a script returns in this tab's browser; None where no answer comes in time."""
    try:
        return await ui.run_javascript(script, timeout=seconds)
    except (TimeoutError, RuntimeError):  # RuntimeError: the client was deleted
        return None


async def prefers_dark() -> bool:
    """Whether the browser asks for dark pages."""
    return bool(await answer_of("matchMedia('(prefers-color-scheme: dark)').matches"))
