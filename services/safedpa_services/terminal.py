"""Safe terminal output with Rich: text from the bus cannot move the cursor, change colours or hide other text."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, final

from rich.console import Console, ConsoleOptions, ConsoleRenderable, RenderHook, RichCast
from rich.segment import Segment

from safedpa.limits import printable


def terminal(**options: Any) -> Console:
    """Returns a console that prints text literally: without markup, and without control characters.

    Highlighting is off, because Rich's patterns take minutes on a word of 100 000 letters.
    """
    console = Console(**{"markup": False, "emoji": False, "highlight": False, **options})
    console.push_render_hook(_Hook())
    return console


@final
class SanitizedRenderable:
    """Wraps a renderable and replaces its unprintable characters; the width does not change."""

    def __init__(self, drawn: Any) -> None:
        self._drawn = drawn

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[Segment]:
        """Yields the segments. Control segments, by which the console itself moves the cursor, are not changed."""
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
        """Returns the renderables, each wrapped in ``SanitizedRenderable``."""
        wrapped: list[ConsoleRenderable] = []
        for item in renderables:
            plain = item.__rich__() if isinstance(item, RichCast) else item
            wrapped.append(plain if type(plain).__name__ == "Control" else SanitizedRenderable(plain))  # type: ignore[arg-type]
        return wrapped
