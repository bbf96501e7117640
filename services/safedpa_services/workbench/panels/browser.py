"""Runs scripts in the browser of a tab. A closed or busy tab is no error: the result is None."""

from __future__ import annotations

from typing import Any

from nicegui import ui

_SECONDS = 5.0


async def run_script(script: str, seconds: float = _SECONDS) -> Any:
    """Runs JavaScript in this tab's browser and returns its result; None if no answer comes in time."""
    try:
        return await ui.run_javascript(script, timeout=seconds)
    except (TimeoutError, RuntimeError):  # RuntimeError: the client was deleted
        return None


async def prefers_dark_mode() -> bool:
    """Whether the browser prefers dark pages."""
    return bool(await run_script("matchMedia('(prefers-color-scheme: dark)').matches"))
