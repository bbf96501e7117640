"""What is drawn on a terminal: names and sentences of others move no cursor, colour nothing and hide nothing."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, final

from rich.console import Console, ConsoleOptions, ConsoleRenderable, RenderHook, RichCast
from rich.segment import Segment

from safedpa.limits import printable

__all__ = ["SanitizedRenderable", "terminal"]


def terminal(**options: Any) -> Console:
    """A console on which text is text: no markup, and no control characters from what is printed.

    Nor does it look for numbers and addresses to colour: for that a word of 100 000 letters takes it minutes.
    """
    console = Console(**{"markup": False, "emoji": False, "highlight": False, **options})
    console.push_render_hook(_Hook())
    return console


@final
class SanitizedRenderable:
    """Something drawn, each character of its text that is not printable replaced; the width stays."""

    def __init__(self, drawn: Any) -> None:
        self._drawn = drawn

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[Segment]:
        """The segments of what is drawn; those by which the console itself moves the cursor stay as they are."""
        for segment in console.render(self._drawn, options):
            text = segment.text
            if segment.control or text.isprintable() or text == "\n":
                yield segment
            else:
                plain = printable(text, also="\n")
                yield Segment(plain, segment.style)


@final
class _Hook(RenderHook):
    def process_renderables(self, renderables: list[ConsoleRenderable]) -> list[ConsoleRenderable]:
        """All of them, as they are shown."""
        wrapped: list[ConsoleRenderable] = []
        for item in renderables:
            plain = item.__rich__() if isinstance(item, RichCast) else item
            wrapped.append(plain if type(plain).__name__ == "Control" else SanitizedRenderable(plain))  # type: ignore[arg-type]
        return wrapped
