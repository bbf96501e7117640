"""The program of Rerun's web viewer, to be served from here.

The library's own server for it listens on every interface of the machine, and says nothing of where it may listen.
So the program is fetched once, when it is first asked for, from Rerun's command line listening on the loopback
interface for that moment, and served by anyone who has the page.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tempfile
import threading
import time
import urllib.error
import urllib.request
from importlib.util import find_spec
from pathlib import Path

from safedpa.bus.transport.ports import free_port
from safedpa.errors import SafedpaError

__all__ = ["VIEWER_POLICY", "Viewer"]

_FILES = {
    "": "text/html; charset=utf-8",
    "re_viewer.js": "text/javascript",
    "re_viewer_bg.wasm": "application/wasm",
    "sw.js": "text/javascript",
    "favicon.ico": "image/x-icon",
}
_PATIENCE_SECONDS = 30.0
_LARGEST_BYTES = 256 << 20
VIEWER_POLICY = (
    "default-src 'self' blob: data:; script-src 'self' 'unsafe-inline' 'unsafe-eval' 'wasm-unsafe-eval' blob:; "
    "style-src 'self' 'unsafe-inline'; connect-src 'self' blob: data:{more}; worker-src 'self' blob:; "
    "object-src 'none'; base-uri 'self'; frame-ancestors 'self'"
)
"""Of the viewer's page: the browser refuses every other host, which the viewer would ask for news and fonts."""


class Viewer:
    """The viewer's files, fetched with the first question; may be asked by several threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._files: dict[str, bytes] = {}

    def file(self, name: str) -> tuple[bytes, str] | None:
        """Content and type of a file, ``""`` of the page itself; None where there is no such file.

        Raises SafedpaError where Rerun's command line cannot be started.
        """
        wanted = "" if name == "index.html" else name
        if wanted not in _FILES:
            return None
        with self._lock:
            if not self._files:
                self._files = _fetched()
        return self._files[wanted], _FILES[wanted]


def _fetched() -> dict[str, bytes]:
    port = free_port()
    with tempfile.TemporaryDirectory(prefix="safedpa-viewer-") as home:
        # a home of its own: the program would keep settings, and tell its makers of the session after the first
        environment = {"PATH": os.environ.get("PATH", ""), "HOME": home, "XDG_CONFIG_HOME": home, "RUST_LOG": "error"}
        process = subprocess.Popen(
            _command(port),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env={**environment, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        )
        try:
            return {name: _fetch(f"http://127.0.0.1:{port}/{name}", process) for name in _FILES}
        finally:
            process.kill()
            process.wait()


def _command(port: int) -> list[str]:
    """Rerun's command line; where it is not installed, as in our images, the library in a process that ends at once."""
    found = find_spec("rerun_cli")
    program = None if found is None or found.origin is None else Path(found.origin).parent / "rerun"
    if program is not None and program.exists():
        no_answer = "rerun+http://127.0.0.1:9/proxy"  # with an address to look at it serves no data itself
        return [str(program), "--serve-web", "--bind", "127.0.0.1", "--web-viewer-port", str(port), no_answer]
    return [
        sys.executable,
        "-c",
        f"import rerun,time;rerun.serve_web_viewer(web_port={port},open_browser=False);time.sleep(30)",
    ]


def _fetch(address: str, process: subprocess.Popen[bytes]) -> bytes:
    until = time.monotonic() + _PATIENCE_SECONDS
    while process.poll() is None and time.monotonic() < until:
        with (
            contextlib.suppress(urllib.error.URLError, ConnectionError),
            urllib.request.urlopen(address, timeout=20) as answer,
        ):
            content: bytes = answer.read(_LARGEST_BYTES)
            return content
        time.sleep(0.05)
    raise SafedpaError("viewer: Rerun's command line did not serve its viewer; is the port range of this machine full?")
