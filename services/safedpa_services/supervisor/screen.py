"""Shows the view live on a terminal, plain lines in a pipe, nothing when asked to be quiet."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.live import Live

from safedpa_services.supervisor.child import Child
from safedpa_services.supervisor.view import view_of
from safedpa_services.supervisor.warnings import Warnings
from safedpa_services.supervisor.watch import Watch
from safedpa_services.terminal import Shown, terminal

__all__ = ["screen"]

_REDRAW_SECONDS = 0.25


@contextmanager
def screen(
    watch: Watch, services: Sequence[Child], robot: Child, hints: list[str], folder: Path, *, quiet: bool
) -> Iterator[Callable[[], None]]:
    """Yields a function to call often; it redraws at most four times a second. ``folder`` is the run's."""
    console = terminal(stderr=True)
    if quiet:
        yield Warnings((robot, *services), folder).look
        return
    if not console.is_terminal:
        for hint in hints:
            console.print(hint, soft_wrap=True)
        yield _Announcement(watch, console, Warnings((robot, *services), folder, _printer(console)))
        return
    warnings = Warnings((robot, *services), folder)
    drawn = 0.0
    with Live(console=console, auto_refresh=False) as live:

        def redraw() -> None:
            nonlocal drawn
            warnings.look()
            if time.monotonic() - drawn >= _REDRAW_SECONDS:
                drawn = time.monotonic()
                view = view_of(watch, services, robot, [*_live_view(watch), *hints], warnings.newest)
                live.update(Shown(view), refresh=True)

        yield redraw


def _printer(console: Console) -> Callable[[str], None]:
    return lambda line: console.print(line, soft_wrap=True, markup=False, highlight=False)


class _Announcement:
    """Tells the dashboard's address once, as soon as it is known, and warnings as they come."""

    def __init__(self, watch: Watch, console: Console, warnings: Warnings) -> None:
        self._watch, self._console, self._warnings = watch, console, warnings
        self._told = False

    def __call__(self) -> None:
        self._warnings.look()
        lines = [] if self._told else _live_view(self._watch)
        for line in lines:
            self._told = True
            self._console.print(line, soft_wrap=True)


def _live_view(watch: Watch) -> list[str]:
    """Where to look, once the dashboard has said so."""
    heard = watch.health.get("dashboard")
    return [f"live view {heard[0].detail}"] if heard is not None and heard[0].detail else []
