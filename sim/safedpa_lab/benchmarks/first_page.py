"""From the start of ``safedpa up`` until its pages answer over HTTP: the dashboard's live view and the workbench."""

from __future__ import annotations

import queue
import signal
import subprocess
import sys
import tempfile
import threading
import time
from typing import IO, Final
from urllib.request import HTTPCookieProcessor, ProxyHandler, build_opener

from safedpa.errors import SafedpaError

__all__ = ["answers", "seconds_to_pages"]

_PATIENCE_SECONDS: Final = 60.0
_LOOK_SECONDS: Final = 0.02
_END_SECONDS: Final = 20.0
_ANSWER_SECONDS: Final = 5.0
_PAGES: Final = ("live view ", "workbench ")
"""How ``safedpa up`` begins the lines that tell an address."""


def seconds_to_pages(pages: tuple[str, ...] = _PAGES) -> dict[str, float]:
    """Seconds from the command until each page that it reports of has answered a request, by the page's name.

    Raises SafedpaError where ``safedpa up`` ends before that, or where no page answers within a minute.
    """
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "safedpa_services", "up", "--out", folder]
        began = time.monotonic()
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        assert process.stderr is not None
        lines: queue.SimpleQueue[str] = queue.SimpleQueue()
        listener = threading.Thread(target=_hand_on, args=(process.stderr, lines), daemon=True)
        listener.start()
        try:
            return _answered(process, lines, pages, began)
        finally:
            process.send_signal(signal.SIGINT)
            try:
                process.wait(_END_SECONDS)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            listener.join(_END_SECONDS)
            process.stderr.close()


def _answered(
    process: subprocess.Popen[str], lines: queue.SimpleQueue[str], pages: tuple[str, ...], began: float
) -> dict[str, float]:
    reported: dict[str, str] = {}
    found: dict[str, float] = {}
    notice = ""
    while len(found) < len(pages):
        while not lines.empty():
            notice = lines.get()
            reported |= {page.strip(): notice.removeprefix(page).strip() for page in pages if notice.startswith(page)}
        for page, address in reported.items():
            if page not in found and answers(address):
                found[page] = time.monotonic() - began
        if process.poll() is not None:
            raise SafedpaError(f"safedpa up: ended with exit code {process.returncode}: {notice.strip()}")
        if time.monotonic() - began > _PATIENCE_SECONDS:
            absent = ", ".join(page.strip() for page in pages if page.strip() not in found)
            raise SafedpaError(f"safedpa up: no answer of {absent} within {_PATIENCE_SECONDS:.0f} s")
        time.sleep(_LOOK_SECONDS)
    return found


def _hand_on(stream: IO[str], lines: queue.SimpleQueue[str]) -> None:
    for line in stream:
        lines.put(line)


def answers(address: str) -> bool:
    """Whether a request there gets a page, as a browser would: with the cookie that its address brings, past proxies.

    That something is not found, or not allowed, is an answer of the server, and no page.
    """
    browser = build_opener(ProxyHandler({}), HTTPCookieProcessor())
    try:
        with browser.open(address, timeout=_ANSWER_SECONDS) as reply:
            return bool(reply.status == 200)
    except OSError:  # what HTTP says of errors is one of them
        return False
