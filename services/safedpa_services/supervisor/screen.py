"""Shows a run: a live view on a terminal, plain lines in a pipe, nothing if quiet."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from safedpa_services.supervisor.child import Child
from safedpa_services.supervisor.log_warnings import LogWarnings
from safedpa_services.supervisor.run_monitor import RunMonitor

if TYPE_CHECKING:
    from rich.console import Console


_REDRAW_SECONDS = 0.25
_PROBE_SECONDS = 0.05


@contextmanager
def screen(
    watch: RunMonitor,
    services: Sequence[Child],
    robot: Child,
    hints: list[str],
    folder: Path,
    *,
    quiet: bool,
    page: str = "",
) -> Iterator[Callable[[], None]]:
    """Yields a function to call often; it redraws at most four times a second.

    :param hints: lines that tell the user where the recording is and how to join
    :param folder: folder of the run
    :param page: address of the workbench, shown as soon as it accepts connections
    """
    if quiet:
        yield LogWarnings((robot, *services), folder).look
        return
    from rich.live import Live  # a slow import that a quiet run does not need

    from safedpa_services.supervisor.view import render_view
    from safedpa_services.terminal import SanitizedRenderable, terminal

    workbench = _Page(page)
    console = terminal(stderr=True)
    if not console.is_terminal:
        for hint in hints:
            console.print(hint, soft_wrap=True)
        yield _Announcement(watch, workbench, console, LogWarnings((robot, *services), folder, _printer(console)))
        return
    warnings = LogWarnings((robot, *services), folder)
    drawn = 0.0
    with Live(console=console, auto_refresh=False) as live:

        def redraw() -> None:
            nonlocal drawn
            warnings.look()
            if time.monotonic() - drawn >= _REDRAW_SECONDS:
                drawn = time.monotonic()
                view = render_view(
                    watch, services, robot, [*_live_view(watch), *workbench.lines(), *hints], warnings.newest
                )
                live.update(SanitizedRenderable(view), refresh=True)

        yield redraw


def _printer(console: Console) -> Callable[[str], None]:
    return lambda line: console.print(line, soft_wrap=True, markup=False, highlight=False)


class _Announcement:
    """Prints each address once, as soon as it accepts connections, and warnings as they arrive."""

    def __init__(self, watch: RunMonitor, page: _Page, console: Console, warnings: LogWarnings) -> None:
        self._watch, self._page, self._console, self._warnings = watch, page, console, warnings
        self._reported: set[str] = set()

    def __call__(self) -> None:
        self._warnings.look()
        for line in [*_live_view(self._watch), *self._page.lines()]:
            kind = line.split(" ", maxsplit=1)[0]
            if kind not in self._reported:
                self._reported.add(kind)
                self._console.print(line, soft_wrap=True)


class _Page:
    """An address on this machine that is shown once it accepts connections."""

    def __init__(self, address: str) -> None:
        self._address = address
        self._answers = False
        self._next_look = 0.0

    def lines(self) -> list[str]:
        """Returns a line with the address; nothing while it accepts no connections."""
        if not self._address:
            return []
        if not self._answers and time.monotonic() >= self._next_look:
            self._next_look = time.monotonic() + _REDRAW_SECONDS
            self._answers = answers(self._address)
        return [f"workbench {self._address}"] if self._answers else []


def answers(address: str) -> bool:
    """Returns whether a server on this machine accepts connections at an address."""
    parts = urlsplit(address)
    try:
        socket.create_connection((parts.hostname or "127.0.0.1", parts.port or 80), _PROBE_SECONDS).close()
    except OSError:
        return False
    return True


def _live_view(watch: RunMonitor) -> list[str]:
    """Returns the dashboard's address once its health message contains it."""
    known = watch.health.get("dashboard")
    return [f"live view {known[0].detail}"] if known is not None and known[0].detail else []
