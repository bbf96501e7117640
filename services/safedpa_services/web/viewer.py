"""The files of Rerun's web viewer, to be served by our own web servers.

Rerun's own server for them listens on all network interfaces and cannot be restricted. The files are therefore fetched
once, on first use, from Rerun's command line, which listens on the loopback interface for that moment.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import subprocess
import sys
import tempfile
import threading
import time
import urllib.error
import urllib.request
from collections.abc import AsyncIterator
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path

from starlette.responses import PlainTextResponse, Response, StreamingResponse

from safedpa.bus.transport.ports import free_port
from safedpa.errors import SafedpaError

_FILES = {
    "": "text/html; charset=utf-8",
    "re_viewer.js": "text/javascript",
    "re_viewer_bg.wasm": "application/wasm",
    "sw.js": "text/javascript",
    "favicon.ico": "image/x-icon",
}
_PATIENCE_SECONDS = 30.0
_LARGEST_BYTES = 256 << 20
_PART_BYTES = 1 << 16
_OPTIONS, _MEMORY_LIMIT = b"const options = {", b'const options = { memory_limit: "60MB",'
"""In the viewer's page: without this option the viewer keeps up to 2.3 GB of data in the browser; with it, it drops the
oldest. The page takes no such option from its address."""
VIEWER_POLICY = (
    "default-src 'self' blob: data:; script-src 'self' 'unsafe-inline' 'unsafe-eval' 'wasm-unsafe-eval' blob:; "
    "style-src 'self' 'unsafe-inline'; connect-src 'self' blob: data:{more}; worker-src 'self' blob:; "
    "object-src 'none'; base-uri 'self'; frame-ancestors 'self'"
)
"""Content security policy of the viewer's page. It blocks other hosts, from which the viewer would load news and
fonts."""


class Viewer:
    """The viewer's files, fetched on first use; thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._files: dict[str, bytes] = {}

    def file(self, name: str) -> tuple[bytes, str] | None:
        """Returns content and type of a file, ``""`` being the page itself; None if there is no such file.

        Raises SafedpaError if Rerun's command line cannot be started.
        """
        wanted = "" if name == "index.html" else name
        if wanted not in _FILES:
            return None
        with self._lock:
            if not self._files:
                self._files = _fetched()
                self._files[""] = _watched(self._files[""].replace(_OPTIONS, _MEMORY_LIMIT))
        return self._files[wanted], _FILES[wanted]


async def viewer_file(viewer: Viewer, name: str, more: str = "") -> Response:
    """Returns the response with a file of the viewer, whose page may also read data from the host ``more``."""
    try:
        found = await asyncio.to_thread(viewer.file, name)
    except SafedpaError as error:
        return PlainTextResponse(f"{error}\n", 503)
    if found is None:
        return PlainTextResponse("no such file\n", 404)
    content, kind = found
    headers = {
        "Content-Type": kind,
        "Content-Length": str(len(content)),
        "Content-Security-Policy": VIEWER_POLICY.format(more=more),
        "Content-Encoding": "identity",  # declared as encoded: compressing 40 MB would block every page for seconds
    }
    # in parts, so that a client that reads slowly does not make the server keep 40 MB for it
    return StreamingResponse(_parts(content), headers=headers)


async def _parts(content: bytes) -> AsyncIterator[bytes]:
    for start in range(0, len(content), _PART_BYTES):
        yield content[start : start + _PART_BYTES]


def _watched(page: bytes) -> bytes:
    script = (files("safedpa_services.web") / "viewer_watch.js").read_bytes()
    return page.replace(b"<head>", b"<head><script>" + script + b"</script>", 1)


def _fetched() -> dict[str, bytes]:
    port = free_port()
    with tempfile.TemporaryDirectory(prefix="safedpa-viewer-") as home:
        # a separate home: otherwise the program writes settings there and, from the second run on, sends analytics
        environment = {"PATH": os.environ.get("PATH", ""), "HOME": home, "XDG_CONFIG_HOME": home, "RUST_LOG": "error"}
        environment["PYTHONSAFEPATH"] = "1"
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


def viewer_program() -> str | None:
    """Returns the path of Rerun's command line; None if it is not installed, as in our images."""
    found = find_spec("rerun_cli")
    program = None if found is None or found.origin is None else Path(found.origin).parent / "rerun"
    return str(program) if program is not None and program.is_file() else None


def _command(port: int) -> list[str]:
    """Returns the command of Rerun's server or, if that is not installed, of its library."""
    program = viewer_program()
    if program is not None:
        no_answer = "rerun+http://127.0.0.1:9/proxy"  # with an address of data it does not start a data server
        return [program, "--serve-web", "--bind", "127.0.0.1", "--web-viewer-port", str(port), no_answer]
    code = f"import rerun,time;rerun.serve_web_viewer(web_port={port},open_browser=False);time.sleep(30)"
    return [sys.executable, "-c", code]


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
    raise SafedpaError(
        "viewer: Rerun's command line did not serve the viewer's files; check that a free port is left on this machine"
    )
