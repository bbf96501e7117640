"""Screenshots of the page for the documentation, taken by a headless Chromium that performs the five steps."""

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

_TIMEOUT = 300_000
"""ms; the search for effects in a long recording can take minutes."""
_DRAW_TIME = 1200
"""ms that the browser needs to draw the figures."""
_AFTER_CHANGE = 15_000
"""ms between a model change and its screenshot: the error after the change is a median of some seconds."""
_CHROMIUM_OPTIONS = ("--no-sandbox", "--disable-background-networking")


def take_screenshots(arguments: Sequence[str], folder: Path, *, live: bool) -> Iterator[Path]:
    """Starts ``safedpa workbench`` with ``arguments`` and yields the path of each screenshot once it is written.

    For recordings: workbench_where.png, workbench_candidates.png, workbench_added.png and workbench_open.png. For
    running robots: workbench_live.png, once there are candidates; for a replay also workbench_changed.png.
    Raises SafedpaError if there is no browser, or if the page does not reach a step in time.
    """
    steps = (_REPLAYED if "--replay" in arguments else _LIVE) if live else _RECORDED
    browser = find_browser()
    folder.mkdir(parents=True, exist_ok=True)
    with _served(arguments) as address, _opened(browser, address, (1280, 800), "pictures") as page:
        for name, step in steps.items():
            step(page)
            page.wait_for_timeout(_DRAW_TIME)
            page.screenshot(path=folder / name)
            yield folder / name


def take_screenshot(address: str, path: Path) -> None:
    """Writes a screenshot (1400 x 900) of the page at ``address``; raises SafedpaError on failure."""
    with _opened(find_browser(), address, (1400, 900), str(path)) as page:
        page.wait_for_selector(".stages .value")
        page.wait_for_timeout(_DRAW_TIME)
        page.screenshot(path=path)


@contextmanager
def _opened(browser: str, address: str, size: tuple[int, int], what: str) -> Iterator[Any]:
    """Yields the page at an address. Raises SafedpaError, which begins with ``what``, if a step of it fails."""
    from playwright.sync_api import Error, sync_playwright

    try:
        with sync_playwright() as play:
            started = play.chromium.launch(executable_path=browser, args=list(_CHROMIUM_OPTIONS))
            page = started.new_page(viewport={"width": size[0], "height": size[1]})
            page.set_default_timeout(_TIMEOUT)
            page.goto(address)
            yield page
            started.close()
    except Error as error:
        raise SafedpaError(f"{what}: the page did not reach the next step ({str(error).splitlines()[0]})") from error


def find_browser() -> str:
    """Returns the path of Chromium; raises SafedpaError if Chromium or playwright is not installed."""
    found = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if found is None:
        raise SafedpaError("pictures: no Chromium; install it (Debian: apt-get install chromium)")
    if importlib.util.find_spec("playwright") is None:
        raise SafedpaError("pictures: playwright is not installed; run: pip install playwright")
    return found


@contextmanager
def _served(arguments: Sequence[str]) -> Iterator[str]:
    port = free_port()
    command = [sys.executable, "-m", "safedpa_services", "workbench", *arguments, "--no-browser", "--port", str(port)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONSAFEPATH": "1"}
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
    try:
        line = server.stdout.readline() if server.stdout is not None else ""
        if not line.startswith("Workbench:"):
            raise SafedpaError("pictures: the page could not be served; the reason is printed above")
        yield line.split()[1]
    finally:
        server.terminate()
        server.wait(20)
        if server.stdout is not None:
            server.stdout.close()


def _show_worst_cell(page: Any) -> None:
    """Selects the worst cell of the error map while the search is running."""
    page.wait_for_selector(".heatmaplayer", state="attached")
    _press(page, "m", "text=/windows: error/")


def _press(page: Any, key: str, shown: str) -> None:
    page.keyboard.press(key)
    page.wait_for_selector(shown)


def _add_two(page: Any) -> None:
    """Adds the two best candidates and waits for the next search."""
    for _ in range(2):
        bars = page.locator(".stages .value").count()
        page.keyboard.press("a")
        page.wait_for_function(f"document.querySelectorAll('.stages .value').length > {bars}")
        page.wait_for_selector(".candidate")


def _show_change(page: Any) -> None:
    """Waits until the error after the model change has settled."""
    page.wait_for_selector("text=/since the change/")
    page.wait_for_timeout(_AFTER_CHANGE)


_RECORDED: dict[str, Callable[[Any], None]] = {
    "workbench_where.png": _show_worst_cell,
    "workbench_candidates.png": lambda page: _press(page, "c", ".candidate"),
    "workbench_added.png": _add_two,
    "workbench_open.png": lambda page: _press(page, "o", ".preview table"),
}
_LIVE: dict[str, Callable[[Any], None]] = {"workbench_live.png": lambda page: page.wait_for_selector(".candidate")}
_REPLAYED: dict[str, Callable[[Any], None]] = {**_LIVE, "workbench_changed.png": _show_change}
"""A recording contains an accepted change; on a running robot only the user may accept one."""
