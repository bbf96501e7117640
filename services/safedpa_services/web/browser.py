"""Shows a page's address, and opens it in the user's browser, without revealing its token to other users."""

from __future__ import annotations

import contextlib
import html
import os
import tempfile
import threading
import webbrowser
from pathlib import Path

_KEEP_SECONDS = 60.0
ADDRESS_FILE = "page-address"
"""File of a run's folder with the address of its page, including the token."""


def show(address: str) -> None:
    """Opens an address through a redirecting file: other users can read a browser's arguments, but not this file."""
    handle, name = tempfile.mkstemp(prefix="safedpa-page-", suffix=".html")  # created with mode 0600
    with os.fdopen(handle, "w", encoding="utf-8") as file:
        file.write(f'<meta http-equiv="refresh" content="0; url={html.escape(address)}">')
    threading.Thread(target=webbrowser.open, args=(Path(name).as_uri(),), daemon=True).start()
    timer = threading.Timer(_KEEP_SECONDS, _remove, (name,))
    timer.daemon = True
    timer.start()


def shown_address(address: str, folder: Path, *, is_terminal: bool) -> str:
    """Returns a page's address for people; its token is part of it on a terminal only.

    The output of a command in a pipe is often a log that others can read. There, the full address is in a file of
    ``folder`` that only this user can read.
    """
    plain, mark, _ = address.partition("?")
    if is_terminal or not mark:
        return address
    path = folder / ADDRESS_FILE
    with contextlib.suppress(OSError):
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
        with os.fdopen(descriptor, "w", encoding="utf-8") as file:
            file.write(address + "\n")
    return f"{plain} (the address with its token is in {path}, for you alone)"


def _remove(name: str) -> None:
    with contextlib.suppress(OSError):
        os.unlink(name)
