"""Small building blocks of the page, with what screen readers and the keyboard need."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

from nicegui import app, ui
from nicegui.element import Element

from safedpa.limits import readable

__all__ = ["action", "apply_page_style", "escaped", "named", "on_change_of", "panel", "text"]


_LONGEST = 20_000
"""Letters of a line."""
_Element = TypeVar("_Element", bound=Element)


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
    """Text with the characters that markup is made of replaced, and those that hide or reorder others made visible."""
    content = "\n".join(readable(line, _LONGEST) for line in content.split("\n"))
    return content.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;").replace('"', "&quot;")


def named(element: _Element, title: str) -> _Element:
    """The control with a name for screen readers, on the part of it that takes the focus."""
    part = "input, textarea, .q-slider__track-container"
    handler = f"(node) => node.el?.querySelector?.('{part}')?.setAttribute('aria-label', {json.dumps(title)})"
    if isinstance(element, ui.input | ui.slider):  # hand it on by themselves
        element.props(f'aria-label="{escaped(title)}"')
    on_change_of(element, handler)  # and to the part of it that takes the focus
    return element


def on_change_of(element: Element, handler: str) -> None:
    """Calls a JavaScript function with the element's node whenever the framework has drawn it."""
    element.on("vnodeMounted", js_handler=handler)
    element.on("vnodeUpdated", js_handler=handler)


_HEAD = "<script>document.documentElement.lang = 'en'</script>"
_COLOUR = "#0b5cad"
"""Of main buttons: white letters on it have a contrast of 6.7."""


def apply_page_style(style: str) -> None:
    """What every page begins with: its language, its style, its colours."""
    ui.add_head_html(_HEAD)
    ui.add_css(style)
    ui.colors(primary=_COLOUR)
    app.config.quasar_config["loadingBar"]["skipHijack"] = True  # it has no name for screen readers


def action(title: str, on_click: Callable[..., Any], key: str = "", *, hint: str = "", main: bool = False) -> ui.button:
    """A button with the key that does the same."""
    button = ui.button(on_click=on_click, color="primary" if main else None)
    button.props("dense no-caps unelevated" if main else "dense no-caps outline").classes("small")
    button.props(f'aria-label="{escaped(hint or title)}"' + (f' aria-keyshortcuts="{key}"' if key else ""))
    with button:
        ui.html(escaped(title) + (f"<kbd>{escaped(key)}</kbd>" if key else ""), sanitize=False, tag="span")
    return button
