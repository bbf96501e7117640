"""The demonstration in many scenes: how often does each of its steps succeed?"""

from __future__ import annotations

import datetime
import json
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from safedpa.errors import SafedpaError
from safedpa_lab.experiments.record import Options, ReportProgress, Result

_WANTED_FALL, _WANTED_WAY, _LONGEST_UNSAID = 0.6, 5.0, 10.0
"""Reduction of the error; m driven in the 20 s after the model was changed; s of standing without a message."""
_TIMEOUT = 1200.0
"""s for one drive, on a busy machine."""
_PAGE_SECONDS = 300.0
"""s for each step of a person at the page."""
_CHANGE_SECONDS = 300.0
"""s from the click on Accept to the end of the drive, which ends 20 s of robot time after the model was changed."""
_STEPS = {
    "found": "a finding raised",
    "accepted": "its effect accepted",
    "fell": "error down by 60 %",
    "drove_on": "drove on",
    "notice": "no stop without a message",
    "all": "all of it",
}


def run(options: Options, report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment demo``: each drive is a separate process, in real time."""
    seeds = range(options["seed"], options["seed"] + options["drives"])
    drives: list[dict[str, Any]] = []
    with _busy(options["busy"]), ThreadPoolExecutor(options["parallel"]) as pool:
        for drive in pool.map(partial(_drive, folder=options["recordings"], clicks=options["click"]), seeds):
            drives.append(drive)
            report_progress(len(drives), len(seeds))
    return {
        "experiment": "demo",
        "date": datetime.date.today().isoformat(),
        "seeds": [seeds.start, seeds.stop - 1],
        "alongside": options["parallel"],
        "busy": options["busy"],
        "clicks": options["click"],
        "wanted": {"fall": _WANTED_FALL, "way_after_m": _WANTED_WAY, "longest_stand_unsaid_s": _LONGEST_UNSAID},
        "drives": len(drives),
        **{step: sum(drive[step] for drive in drives) for step in _STEPS},
        "each": drives,
    }


@contextmanager
def _busy(count: int) -> Iterator[None]:
    """Keeps ``count`` processes computing, as other work on the machine does."""
    others = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for other in others:
            other.kill()
            other.wait()


def _drive(seed: int, folder: Path, *, clicks: bool) -> dict[str, Any]:
    command = [sys.executable, "-m", "safedpa_services", "demo", "--json", "--seed", str(seed)]
    try:
        if clicks:
            output, errors, message = _clicked(command, folder)
        else:
            command += ["--yes", "--headless", "--out", str(folder)]
            done = subprocess.run(command, capture_output=True, text=True, timeout=_TIMEOUT, check=False)
            output, errors, message = done.stdout, done.stderr, ""
        return judged(json.loads(output)) | ({"page": message} if clicks else {})
    except subprocess.TimeoutExpired:
        failure = f"not over after {_TIMEOUT:.0f} s"
    except json.JSONDecodeError:
        failure = errors.strip().splitlines()[-1][:300] if errors.strip() else "no output"
    return {"seed": seed, "failure": failure, **dict.fromkeys(_STEPS, False)}


def _clicked(command: list[str], folder: Path) -> tuple[str, str, str]:
    """Runs a demonstration whose model a person at the page changes by a single click on Accept.

    Returns the output of the command, its errors, and the message of the page about the click.
    """
    folder.mkdir(parents=True, exist_ok=True)
    own = Path(tempfile.mkdtemp(prefix="demo-", dir=folder))
    command = [*command, "--no-browser", "--out", str(own)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as running:
        try:
            message = _accept_on_page(own, running)
        except SafedpaError as error:
            message = str(error)
        finally:
            if running.poll() is None:
                running.send_signal(signal.SIGINT)
        output, errors = running.communicate(timeout=_PAGE_SECONDS)
    return output, errors, message


def _accept_on_page(folder: Path, running: subprocess.Popen[str]) -> str:
    """Clicks Accept once, and keeps the page open until the drive is over; returns the message about the click."""
    from playwright.sync_api import Error, sync_playwright

    from safedpa_services.workbench.screenshots import find_browser

    address = _address(folder, running)
    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=find_browser(), args=["--no-sandbox"])
        try:
            page = browser.new_page(viewport={"width": 1400, "height": 900})
            page.set_default_timeout(1e3 * _PAGE_SECONDS)
            page.goto(address)
            page.get_by_role("button", name=re.compile("^accept ")).first.click()
            message = page.get_by_text(re.compile("^(Accepted|Refused|No diagnosis)")).first.inner_text()
        except Error as error:
            raise SafedpaError(f"page: {str(error).splitlines()[0]}") from error
        until = time.monotonic() + _CHANGE_SECONDS
        while running.poll() is None and time.monotonic() < until:
            page.wait_for_timeout(500.0)
        browser.close()
    return message


def _address(folder: Path, running: subprocess.Popen[str]) -> str:
    """Returns the address of the page with its token, once there is one."""
    from safedpa_services.web.browser import ADDRESS_FILE

    until = time.monotonic() + _PAGE_SECONDS
    while running.poll() is None and time.monotonic() < until:
        for path in folder.glob(f"*/{ADDRESS_FILE}"):
            if address := path.read_text(encoding="utf-8").strip():
                return address
        time.sleep(0.2)
    raise SafedpaError(f"page: got none within {_PAGE_SECONDS:.0f} s")


def judged(reported: dict[str, Any]) -> dict[str, Any]:
    """The document of one demonstration, with the steps of it that succeeded."""
    changed = reported["changed"]
    steps = {
        "found": reported["raised"] is not None and changed is not None and reported["raised"] >= changed,
        "accepted": reported["taken"] is not None,
        "fell": reported["fall"] is not None and reported["fall"] >= _WANTED_FALL,
        "drove_on": reported["way_after"] >= _WANTED_WAY,
        "notice": reported["longest_stand_unsaid"] <= _LONGEST_UNSAID,
    }
    retained = {name: value for name, value in reported.items() if name not in ("recording", "report", "picture")}
    return {**retained, **steps, "all": all(steps.values())}


def report(result: Result) -> str:
    """How often each step succeeded, and what failed in the other drives."""
    lines = [f"{title}: {result[step]}/{result['drives']}" for step, title in _STEPS.items()]
    for drive in result["each"]:
        if not drive["all"]:
            missing = ", ".join(step for step in _STEPS if step != "all" and not drive[step])
            lines.append(f"seed {drive['seed']}: not {missing}; {drive['failure']}")
    return "\n".join(lines)
