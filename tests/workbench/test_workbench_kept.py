"""Nothing is lost: F5, a closed tab, two tabs, Save during a search, a killed server with an open tab. And nothing on
the terminal."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from safedpa.bus.transport import ports

pytestmark = [pytest.mark.long, pytest.mark.slow, pytest.mark.browser, pytest.mark.processes]

PATIENCE = 240_000
"""ms; a search takes seconds, on a busy machine more."""
POLLING = 100
"""ms; a page that is asked at every picture that it draws computes nothing else."""
BUSY_SECONDS = 18.0
"""Longer than a page that answers nothing was kept when that was 10 s; no longer than the shortest now."""
BARS = "document.querySelectorAll('.stages .value').length === {}"


class WorkbenchProcess:
    """``safedpa workbench`` as a person starts it."""

    def __init__(self, folder: Path, port: int):
        self.folder, self.port = folder, port
        self.server: subprocess.Popen[str] | None = None
        self.terminal = (folder / "terminal.txt").open("a+", encoding="utf-8")

    def start(self, *arguments: object) -> str:
        program = [sys.executable, "-m", "safedpa_services", "workbench", *map(str, arguments)]
        options = ["--no-browser", "--port", str(self.port), "--out", str(self.folder / "out")]
        environment = {name: value for name, value in os.environ.items() if name != "PYTEST_CURRENT_TEST"}
        environment["OMP_NUM_THREADS"] = "1"
        self.server = subprocess.Popen(
            [*program, *options], stdout=subprocess.PIPE, stderr=self.terminal, text=True, env=environment
        )
        return self.server.stdout.readline().split()[1]

    def end(self, number: int = signal.SIGINT) -> None:
        if self.server is not None:
            self.server.send_signal(number)
            self.server.wait(PATIENCE / 1000)
            self.server.stdout.close()
            self.server = None

    @property
    def notice(self) -> str:
        self.terminal.seek(0)
        return self.terminal.read()

    @property
    def decisions(self) -> list[tuple[str, str]]:
        session = json.loads((self.folder / "out" / "session.json").read_text(encoding="utf-8"))
        return [(item["do"], item["effect"]) for item in session["decisions"]]


@pytest.fixture(scope="module")
def workbench(tmp_path_factory):
    """One process for all tests; its first start is ``shared_workbench``."""
    made = WorkbenchProcess(tmp_path_factory.mktemp("bench"), ports.free_port())
    yield made
    made.end()
    made.terminal.close()


@pytest.fixture(scope="module")
def shared_workbench(workbench, short_drives):
    """The address of that one, started with a drive. The last test of this file ends it; no other decides anything."""
    model, runs = short_drives
    return workbench.start(model, runs[0])


NOTE_SAVING = """() => {
    window.saving = false;
    const look = () => { window.saving ||= document.body.innerText.includes('Saving: '); };
    new MutationObserver(look).observe(document.body, {childList: true, subtree: true, characterData: true});
}"""
"""In a busy browser, saving may end before the test looks for its message."""


def opened(browser, address, bars):
    page = browser.new_page(viewport={"width": 1280, "height": 800})
    page.goto(address)
    page.wait_for_function(BARS.format(bars), polling=POLLING, timeout=PATIENCE)
    return page


def errors(page):
    return page.locator(".stages .value").all_inner_texts()


def test_a_page_whose_browser_is_busy_for_long_is_not_reloaded(browser, shared_workbench):
    """What was typed in it would be lost. An unanswered question keeps a browser as busy as a lack of time."""
    page = opened(browser, shared_workbench, 1)
    page.evaluate("window.stays = true")
    page.on("dialog", lambda asked: (time.sleep(BUSY_SECONDS), asked.accept()))
    page.evaluate("alert('busy')")
    page.wait_for_timeout(2000)  # a forgotten page would reload now
    assert page.evaluate("window.stays === true")
    page.get_by_label("select the cell of the map with the largest error").click()
    page.wait_for_selector("text=/windows: error/", timeout=PATIENCE)
    page.close()


def test_nothing_is_lost(browser, workbench, shared_workbench):
    address = shared_workbench
    for _ in range(3):  # tabs that go while they load: what is asked of them is never answered
        page = browser.new_page()
        page.goto(address, wait_until="commit")
        page.close()
    page = opened(browser, address, 1)
    page.keyboard.press("r")  # the viewer's recording is written while the tab reloads
    page.reload(wait_until="commit")
    page.wait_for_function(BARS.format(1), polling=POLLING, timeout=PATIENCE)
    assert "will refuse it" not in page.content()
    page.wait_for_selector(".candidate", timeout=PATIENCE)
    page.click(".candidate.open >> text=Add")
    page.wait_for_function(BARS.format(2), polling=POLLING, timeout=PATIENCE)
    retained = errors(page)
    assert workbench.decisions == [("added", "quadratic_drag")]

    page.evaluate(NOTE_SAVING)
    page.keyboard.press("s")  # while the next search goes on
    page.wait_for_selector("text=/Written: .*model.toml.*: safedpa up --model .*--margin/", timeout=PATIENCE)
    assert page.evaluate("window.saving"), "while it saves, the page says so"
    page.reload()  # F5
    page.wait_for_function(BARS.format(2), polling=POLLING, timeout=PATIENCE)
    assert errors(page) == retained
    page.wait_for_selector("text=/Written: .*model.toml/", timeout=PATIENCE)

    other = opened(browser, address.replace("127.0.0.1", "localhost"), 2)  # a second tab
    page.click("text=Undo")
    other.wait_for_function(BARS.format(1), polling=POLLING, timeout=PATIENCE)
    other.wait_for_selector(".candidate", timeout=PATIENCE)
    other.click(".candidate.open >> text=Add")
    page.wait_for_function(BARS.format(2), polling=POLLING, timeout=PATIENCE)
    other.close()
    page.evaluate("window.is_old = true")
    workbench.end(signal.SIGKILL)  # with one tab open

    new = opened(browser, workbench.start(), 2)  # without arguments the last session goes on
    assert errors(new) == retained
    new.close()
    goes_on = f"window.is_old === undefined && {BARS.format(2)}"  # the open tab has the token of the session
    page.wait_for_function(goes_on, polling=POLLING, timeout=PATIENCE)
    assert errors(page) == retained
    page.get_by_label("select the cell of the map with the largest error").click()
    page.wait_for_selector("text=/windows: error/", timeout=PATIENCE)
    page.close()
    workbench.end()
    page = opened(browser, workbench.start("--session", workbench.folder / "out" / "session.json"), 2)
    assert errors(page) == retained
    page.close()
    workbench.end()
    assert "Traceback" not in workbench.notice
    assert "page goes on after an error" not in workbench.notice
