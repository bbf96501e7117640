"""Shows a run: a live view on a terminal, plain lines in a pipe, nothing if quiet."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from urllib.parse import urlsplit

from safedpa_services.supervisor.child import Child
from safedpa_services.supervisor.log_warnings import LogWarnings
from safedpa_services.supervisor.run_monitor import RunMonitor
from safedpa_services.web.browser import shown_address

_REDRAW_SECONDS = 0.25
_PROBE_SECONDS = 0.05


@contextmanager
def screen(
    watch: RunMonitor,
    children: Sequence[Child],
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
        yield LogWarnings(children, folder, notices=watch.notices).look
        return
    from rich.live import Live  # a slow import that a quiet run does not need

    from safedpa_services.supervisor.view import render_view
    from safedpa_services.terminal import SanitizedRenderable, terminal

    console = terminal(stderr=True)
    addresses = _addresses(watch, page, shown_address(page, folder, is_terminal=console.is_terminal))
    if not console.is_terminal:
        say = partial(console.print, soft_wrap=True)
        for hint in hints:
            say(hint)
        yield _announcement(addresses, LogWarnings(children, folder, say, watch.notices), say)
        return
    warnings = LogWarnings(children, folder, notices=watch.notices)
    drawn = 0.0
    with Live(console=console, auto_refresh=False) as live:

        def redraw() -> None:
            nonlocal drawn
            warnings.look()
            if time.monotonic() - drawn >= _REDRAW_SECONDS:
                drawn = time.monotonic()
                view = render_view(watch, children, [*addresses(), *hints], warnings.newest)
                live.update(SanitizedRenderable(view), refresh=True)

        yield redraw


def _announcement(
    addresses: Callable[[], list[str]], warnings: LogWarnings, say: Callable[[str], None]
) -> Callable[[], None]:
    """Returns a function that prints each address once, and warnings as they arrive."""
    reported: set[str] = set()

    def announce() -> None:
        warnings.look()
        for line in addresses():
            kind = line.split(" ", maxsplit=1)[0]
            if kind not in reported:
                reported.add(kind)
                say(line)

    return announce


def _addresses(watch: RunMonitor, page: str, shown: str) -> Callable[[], list[str]]:
    """Returns a function that returns a line for dashboard and workbench, once they accept connections.

    :param shown: the text for the workbench's ``page``
    """
    page_answers, next_look = False, 0.0

    def lines() -> list[str]:
        nonlocal page_answers, next_look
        if page and not page_answers and time.monotonic() >= next_look:
            next_look = time.monotonic() + _REDRAW_SECONDS
            page_answers = answers(page)
        known = watch.health.get("dashboard")  # its health message has the address
        live_view = [f"live view {known[0].detail}"] if known is not None and known[0].detail else []
        return [*live_view, *([f"workbench {shown}"] if page_answers else [])]

    return lines


def answers(address: str) -> bool:
    """Returns whether a server on this machine accepts connections at an address."""
    parts = urlsplit(address)
    try:
        socket.create_connection((parts.hostname or "127.0.0.1", parts.port or 80), _PROBE_SECONDS).close()
    except OSError:
        return False
    return True
