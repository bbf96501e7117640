"""Shows the view live on a terminal, plain lines in a pipe, nothing when asked to be quiet."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from rich.console import Console
from rich.live import Live

from safedpa_services.supervisor.child import Child
from safedpa_services.supervisor.view import view_of
from safedpa_services.supervisor.watch import Watch

__all__ = ["screen"]

_REDRAW_SECONDS = 0.25


@contextmanager
def screen(
    watch: Watch, services: Sequence[Child], robot: Child, hints: list[str], *, quiet: bool
) -> Iterator[Callable[[], None]]:
    """Yields a function to call often; it redraws at most four times a second."""
    console = Console(stderr=True)
    if quiet or not console.is_terminal:
        if not quiet:
            for hint in hints:
                console.print(hint, soft_wrap=True)
        yield lambda: None
        return
    drawn = 0.0
    with Live(console=console, auto_refresh=False) as live:

        def redraw() -> None:
            nonlocal drawn
            if time.monotonic() - drawn >= _REDRAW_SECONDS:
                drawn = time.monotonic()
                live.update(view_of(watch, services, robot, hints), refresh=True)

        yield redraw
