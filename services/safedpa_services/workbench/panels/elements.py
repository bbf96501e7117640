"""Building blocks of the page, accessible to screen readers and the keyboard."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

from nicegui import app, ui
from nicegui.element import Element

from safedpa.limits import readable

_MAX_LENGTH = 20_000
"""Characters of a line."""
_Element = TypeVar("_Element", bound=Element)


@contextmanager
def panel(step: int, title: str) -> Iterator[Any]:
    """A numbered column of the page: a region with its heading."""
    name = f"panel-{step}"
    section = ui.element("section").classes("panel").props(f'aria-labelledby="{name}" tabindex=-1 id="column-{step}"')
    with section:
        with ui.element("h2").props(f'id="{name}"'):
            text(str(step), "step")
            text(title)
        yield section


def text(content: str, classes: str = "", tag: str = "span") -> ui.html:
    """An element with plain text; markup in ``content`` is escaped."""
    return ui.html(escaped(content), sanitize=False, tag=tag).classes(classes)


def escaped(content: str) -> str:
    """Escapes HTML markup, and makes characters visible that hide or reorder others (such as bidi controls)."""
    content = "\n".join(readable(line, _MAX_LENGTH) for line in content.split("\n"))
    return content.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;").replace('"', "&quot;")


def with_table(content: str) -> str:
    """Escaped text in which the lines with cells separated by `` | `` become a table, the first one its head."""
    lines = escaped(content).split("\n")
    rows = [line.split(" | ") for line in lines if " | " in line]
    text = " ".join(line for line in lines if " | " not in line)
    if not rows:
        return text
    head, *body = (
        "<tr>" + "".join(f"<{tag}>{cell}</{tag}>" for cell in cells) + "</tr>"
        for tag, cells in zip(("th", *("td" for _ in rows[1:])), rows, strict=True)
    )
    return f"{text}<table><thead>{head}</thead><tbody>{''.join(body)}</tbody></table>"


def set_accessible_name(element: _Element, title: str) -> _Element:
    """Sets the name that screen readers announce, on the focusable part of the control; returns the control."""
    part = "input, textarea, .q-slider__track-container"
    handler = f"(node) => node.el?.querySelector?.('{part}')?.setAttribute('aria-label', {json.dumps(title)})"
    if isinstance(element, ui.input | ui.slider):  # these pass aria-label on to the focusable part
        element.props(f'aria-label="{escaped(title)}"')
    on_render(element, handler)  # for the others it is set in the browser
    return element


def on_render(element: Element, handler: str) -> None:
    """Calls a JavaScript function with the element's node whenever Vue has mounted or updated it."""
    element.on("vnodeMounted", js_handler=handler)
    element.on("vnodeUpdated", js_handler=handler)


_HEAD = "<script>document.documentElement.lang = 'en'</script>"
_PRIMARY_COLOUR = "#0b5cad"
"""Colour of main buttons; white text on it has a contrast of 6.7 (WCAG AA wants 4.5)."""


def apply_page_style(style: str) -> None:
    """Sets language, style sheet and colours of a page."""
    ui.add_head_html(_HEAD)
    ui.add_css(style)
    ui.colors(primary=_PRIMARY_COLOUR)
    app.config.quasar_config["loadingBar"]["skipHijack"] = True  # the loading bar has no name for screen readers


def button(title: str, on_click: Callable[..., Any], key: str = "", *, hint: str = "", main: bool = False) -> ui.button:
    """A button that shows its keyboard shortcut ``key``; ``hint`` is its accessible name."""
    element = ui.button(on_click=on_click, color="primary" if main else None)
    element.props("dense no-caps unelevated" if main else "dense no-caps outline").classes("small")
    element.props(f'aria-label="{escaped(hint or title)}"' + (f' aria-keyshortcuts="{key}"' if key else ""))
    with element:
        ui.html(escaped(title) + (f"<kbd>{escaped(key)}</kbd>" if key else ""), sanitize=False, tag="span")
    return element
