"""Pictures of the page for documents, made by a headless browser that goes through the five steps."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from safedpa.bus.transport.ports import free_port
from safedpa.errors import SafedpaError

__all__ = ["browser_at_hand", "photograph", "take_pictures"]

_PATIENCE = 300_000
"""ms; a search of a long recording takes a while."""
_MOMENT = 1200
"""ms in which figures are drawn."""
_LATER = 15_000
"""ms after a change at which its picture is taken."""
_SIZE = {"width": 1280, "height": 800}
_HOLD_BACK = ("--no-sandbox", "--disable-background-networking")


def take_pictures(arguments: Sequence[str], folder: Path, *, live: bool) -> Iterator[Path]:
    """Starts ``safedpa workbench`` with arguments and yields each picture as it is written.

    Of recordings: workbench_where.png, workbench_candidates.png, workbench_added.png, workbench_open.png; of driving
    robots workbench_live.png, once candidates are there; of a replay workbench_changed.png as well. Raises SafedpaError
    where there is no browser to take them with, or the page does not come so far.
    """
    browser = browser_at_hand()
    steps = (_REPLAYED if "--replay" in arguments else _LIVE) if live else _RECORDED
    from playwright.sync_api import Error, sync_playwright

    folder.mkdir(parents=True, exist_ok=True)
    try:
        with _served(arguments) as address, sync_playwright() as play:
            started = play.chromium.launch(executable_path=browser, args=list(_HOLD_BACK))
            page = started.new_page(viewport=_SIZE)  # type: ignore[arg-type]
            page.set_default_timeout(_PATIENCE)
            page.goto(address)
            for name, step in steps.items():
                step(page)
                page.wait_for_timeout(_MOMENT)
                page.screenshot(path=folder / name)
                yield folder / name
            started.close()
    except Error as error:
        raise SafedpaError(f"pictures: the page did not come so far ({str(error).splitlines()[0]})") from error


def browser_at_hand() -> str:
    """The program of the browser; raises SafedpaError where there is none that pictures can be taken with."""
    found = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if found is None:
        raise SafedpaError("pictures: no Chromium; install it (Debian: apt-get install chromium)")
    if importlib.util.find_spec("playwright") is None:
        raise SafedpaError("pictures: playwright is not installed; say: pip install playwright")
    return found


def photograph(address: str, path: Path) -> None:
    """A picture of the page at an address as it is now, 1400 x 900; raises SafedpaError where none can be made."""
    browser = browser_at_hand()
    from playwright.sync_api import Error, sync_playwright

    try:
        with sync_playwright() as play:
            started = play.chromium.launch(executable_path=browser, args=list(_HOLD_BACK))
            page = started.new_page(viewport={"width": 1400, "height": 900})
            page.goto(address)
            page.wait_for_selector(".stages .value")
            page.wait_for_timeout(_MOMENT)
            page.screenshot(path=path)
            started.close()
    except Error as error:
        raise SafedpaError(f"{path}: no picture could be made ({str(error).splitlines()[0]})") from error


@contextmanager
def _served(arguments: Sequence[str]) -> Iterator[str]:
    port = free_port()
    command = [sys.executable, "-m", "safedpa_services", "workbench", *arguments, "--no-browser", "--port", str(port)]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"})
    try:
        line = server.stdout.readline() if server.stdout is not None else ""
        if not line.startswith("Workbench:"):
            raise SafedpaError("pictures: the page could not be served; the reason stands above")
        yield line.split()[1]
    finally:
        server.terminate()
        server.wait(20)
        if server.stdout is not None:
            server.stdout.close()


def _see_where(page: Any) -> None:
    """A box around the worst cell, while the search goes on."""
    page.wait_for_selector(".heatmaplayer", state="attached")
    page.keyboard.press("m")
    page.wait_for_selector("text=/windows: error/")


def _candidates(page: Any) -> None:
    page.keyboard.press("c")
    page.wait_for_selector(".candidate")


def _added(page: Any) -> None:
    """The two best additions, and what may be missing next to them."""
    for _ in range(2):
        bars = page.locator(".stages .value").count()
        page.keyboard.press("a")
        page.wait_for_function(f"document.querySelectorAll('.stages .value').length > {bars}")
        page.wait_for_selector(".candidate")


def _open(page: Any) -> None:
    page.keyboard.press("o")
    page.wait_for_selector(".preview table")


def _live(page: Any) -> None:
    page.wait_for_selector(".candidate")


_RECORDED: dict[str, Callable[[Any], None]] = {
    "workbench_where.png": _see_where,
    "workbench_candidates.png": _candidates,
    "workbench_added.png": _added,
    "workbench_open.png": _open,
}


def _changed(page: Any) -> None:
    """Some seconds after the model was changed."""
    page.wait_for_selector("text=/since the change/")
    page.wait_for_timeout(_LATER)


_LIVE: dict[str, Callable[[Any], None]] = {"workbench_live.png": _live}
_REPLAYED: dict[str, Callable[[Any], None]] = {**_LIVE, "workbench_changed.png": _changed}
"""In a recording someone accepted; with a driving robot that is for the person before the page."""
