"""What the pages for recordings and for running robots have in common: header, theme, keys, scripts in the browser."""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

from nicegui import events, ui

from safedpa_services.workbench.panels.elements import button, text
from safedpa_services.workbench.panels.theme import DARK, LIGHT

_SCRIPT_SECONDS = 5.0


class AbstractTab(ABC):
    """One browser tab. A subclass adds to the header, builds the page below it, and names its keys."""

    title: ClassVar[str]
    repeated_keys: ClassVar[tuple[str, ...]] = ()
    """Keys that act again and again while they are held."""

    def __init__(self) -> None:
        self._theme, self._closed = LIGHT, False
        self._dark = ui.dark_mode(None)
        ui.keyboard(self._pressed, ignore=["input", "select", "textarea"])
        with ui.element("main").classes("workbench"):
            ui.html('<a class="skip" href="#column-3">Skip to the candidates</a>', sanitize=False)
            with ui.element("header").classes("top"):
                text(self.title, tag="h1")
                self._what = text("", "what")
                self.build_header()
                button("Dark", self._toggle_dark, "d", hint="switch between dark and light page")
                button("Keys", show_keys, "?", hint="list of keyboard shortcuts")
            self._verdict = text("", "verdict", "div").props('role=status aria-live=polite id="verdict"')
            self.build()

    @abstractmethod
    def build_header(self) -> None:
        """Builds what the header has between the title and the buttons of every page."""

    @abstractmethod
    def build(self) -> None:
        """Builds the page below the header and the verdict."""

    @abstractmethod
    def show(self) -> None:
        """Redraws the page."""

    @abstractmethod
    def keys(self) -> Mapping[str, Callable[[], Any]]:
        """What each key does now, besides those of every page."""

    @property
    def takes_keys(self) -> bool:
        """Whether the keys act."""
        return True

    async def begin(self) -> None:
        """Takes the theme that the browser prefers; called once the browser is connected."""
        dark = await prefers_dark_mode()
        if not self._closed:  # closed during the await
            self._set_dark(dark)

    def close(self) -> None:
        """Called when the tab was closed."""
        self._closed = True

    def _toggle_dark(self) -> None:
        self._set_dark(self._theme is LIGHT)
        self.show()

    def _set_dark(self, dark: bool) -> None:
        self._dark.set_value(dark)
        self._theme = DARK if dark else LIGHT

    async def _pressed(self, event: events.KeyEventArguments) -> None:
        held, key = event.modifiers, str(event.key)
        if not self.takes_keys or not event.action.keydown or held.ctrl or held.alt or held.meta:
            return
        known = {"d": self._toggle_dark, "?": show_keys, **self.keys()}
        if key in known and (key in self.repeated_keys or not event.action.repeat):
            done = known[key]()
            if asyncio.iscoroutine(done):
                await done


async def run_script(script: str, seconds: float = _SCRIPT_SECONDS) -> Any:
    """Runs JavaScript in this tab's browser and returns its result; None if no answer comes in time."""
    try:
        return await ui.run_javascript(script, timeout=seconds)
    except (TimeoutError, RuntimeError):  # RuntimeError: the client was deleted
        return None


async def prefers_dark_mode() -> bool:
    """Whether the browser prefers dark pages."""
    return bool(await run_script("matchMedia('(prefers-color-scheme: dark)').matches"))


KEYS = {
    "Tab, Shift Tab": "move to the next, previous control, in the order of the columns",
    "a": "add the open candidate",
    "x": "reject it",
    "j, k": "next, previous candidate",
    "u": "undo the last decision",
    "s": "save the model and its margin",
    "f": "continue a cancelled search",
    "m": "select the worst cell of the error map",
    "c or Escape": "clear the selection",
    "w": "start the prediction where the error is largest",
    "←, →": "previous, next start",
    "r": "show the same moment in Rerun's viewer (live page: back to recordings)",
    "l": "live page, if the server is connected to a bus",
    "o": "open a model and recordings",
    "d": "switch between dark and light page",
    "?": "this list",
}


def show_keys() -> None:
    """Opens a dialog with the shortcuts."""
    with ui.dialog(value=True).props("aria-label=Keys") as dialog, ui.card():
        rows = "".join(f"<dt>{key}</dt><dd>{what}</dd>" for key, what in KEYS.items())
        ui.html(f'<div class="dialog-title"><h2>Keys</h2></div><dl class="keys">{rows}</dl>', sanitize=False)
        button("Close", dialog.close, main=True).props("data-autofocus")
