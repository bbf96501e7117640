"""The list of keyboard shortcuts."""

from __future__ import annotations

from nicegui import ui

from safedpa_services.workbench.panels.elements import button

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
