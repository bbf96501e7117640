"""Small building blocks of the page, with what screen readers and the keyboard need."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from nicegui import ui

__all__ = ["action", "escaped", "panel", "text"]


@contextmanager
def panel(step: int, title: str) -> Iterator[Any]:
    """One of the page's columns: a region with its heading."""
    name = f"panel-{step}"
    section = ui.element("section").classes("panel").props(f'aria-labelledby="{name}" tabindex=-1 id="column-{step}"')
    with section:
        with ui.element("h2").props(f'id="{name}"'):
            text(str(step), "step")
            text(title)
        yield section


def text(content: str, classes: str = "", tag: str = "span") -> ui.html:
    """A line of text as such, never as markup."""
    return ui.html(escaped(content), sanitize=False, tag=tag).classes(classes)


def escaped(content: str) -> str:
    """Text with the characters that markup is made of replaced."""
    return content.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;").replace('"', "&quot;")


def action(title: str, on_click: Callable[..., Any], key: str = "", *, hint: str = "", main: bool = False) -> ui.button:
    """A button with the key that does the same."""
    button = ui.button(on_click=on_click, color="primary" if main else None)
    button.props("dense no-caps unelevated" if main else "dense no-caps outline").classes("small")
    button.props(f'aria-label="{escaped(hint or title)}"' + (f' aria-keyshortcuts="{key}"' if key else ""))
    with button:
        ui.html(escaped(title) + (f"<kbd>{escaped(key)}</kbd>" if key else ""), sanitize=False, tag="span")
    return button
