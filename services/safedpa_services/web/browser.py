"""Opens a page in the user's browser without revealing its token to other users of the machine."""

from __future__ import annotations

import contextlib
import html
import os
import tempfile
import threading
import webbrowser
from pathlib import Path

_KEEP_SECONDS = 60.0


def show(address: str) -> None:
    """Opens an address through a redirecting file: other users can read a browser's arguments, but not this file."""
    handle, name = tempfile.mkstemp(prefix="safedpa-page-", suffix=".html")  # created with mode 0600
    with os.fdopen(handle, "w", encoding="utf-8") as file:
        file.write(f'<meta http-equiv="refresh" content="0; url={html.escape(address)}">')
    threading.Thread(target=webbrowser.open, args=(Path(name).as_uri(),), daemon=True).start()
    timer = threading.Timer(_KEEP_SECONDS, _remove, (name,))
    timer.daemon = True
    timer.start()


def _remove(name: str) -> None:
    with contextlib.suppress(OSError):
        os.unlink(name)
