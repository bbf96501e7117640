"""The list of keys."""

from __future__ import annotations

from nicegui import ui

from safedpa_services.workbench.elements import action

__all__ = ["KEYS", "show_keys"]

KEYS = {
    "Tab, Shift Tab": "to every control, in the order of the columns",
    "a": "add the candidate that is open",
    "x": "reject it",
    "j, k": "next, previous candidate",
    "u": "undo the last decision",
    "s": "save the model and its margin",
    "f": "search again after it was cancelled",
    "m": "select the worst cell of the error map",
    "c or Escape": "clear the selection",
    "w": "start the prediction where the error is largest",
    "←, →": "previous, next start",
    "r": "the same in Rerun's viewer, at the same moment (live page: back to recordings)",
    "l": "the robots that drive now, where the page is connected to their bus",
    "o": "open a model and recordings",
    "d": "dark or light page",
    "?": "this list",
}


def show_keys() -> None:
    """Opens the list."""
    with ui.dialog(value=True).props("aria-label=Keys") as dialog, ui.card():
        rows = "".join(f"<dt>{key}</dt><dd>{what}</dd>" for key, what in KEYS.items())
        ui.html(f'<div class="dialog-title"><h2>Keys</h2></div><dl class="keys">{rows}</dl>', sanitize=False)
        action("Close", dialog.close, main=True).props("data-autofocus")
