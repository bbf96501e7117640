"""A long run of a fleet with its dashboard in a browser: growth of processes, page and files, judged by limits."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from safedpa.errors import SafedpaError
from safedpa_lab.experiments.record import Options, ReportProgress, Result

if TYPE_CHECKING:
    from playwright.sync_api import Page

GROWTH_MB: Final = 5.0
"""Largest growth of a process from the tenth minute to the end of an hour."""
PAGE_MB: Final = 1000.0
"""Largest memory of all processes of the browser."""
FILE_RATE: Final = 1.0
"""Largest growth of the dashboard's file, relative to that of the recording."""
_SETTLED: Final = 1.0 / 6.0
"""Part of a run in which caches fill: ten minutes of an hour."""
_SAMPLE_SECONDS, _KEPT = 5.0, 6
"""One sample of so many is kept in the result."""
_START_SECONDS, _END_SECONDS = 180.0, 120.0
_BROWSER = ("--no-sandbox", "--disable-background-networking", "--use-gl=angle", "--use-angle=swiftshader")
_DASHBOARD = re.compile(r"live view (http://\S+)")
Sample = dict[str, float]
"""Time [s] as ``seconds``, memory of each process by its name [MB], and sizes of files [MB]."""


def run(options: Options, report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment soak``."""
    seconds = 60.0 * options["minutes"]
    with tempfile.TemporaryDirectory(prefix="safedpa-soak-") as name:
        command = ["--robots", str(options["robots"]), "--seed", str(options["seed"]), "--seconds", repr(seconds)]
        samples, summary = _driven(Path(name), seconds, command, options["samples"], report_progress)
    return {"experiment": "soak", "robots": options["robots"], "minutes": options["minutes"], "run": summary} | judged(
        samples, seconds
    )


def judged(samples: Sequence[Sample], seconds: float) -> dict[str, Any]:
    """Returns the growth of each process [MB in the fifty minutes after the tenth], the page and the file rate.

    The growth of a process is the slope of a line through its samples after the first sixth of the run.
    """
    settled = [one for one in samples if one["seconds"] >= _SETTLED * seconds]
    names = sorted({name for one in settled for name in one} - {"seconds", "page", "recording", "dashboard file"})
    growth = {name: 3000.0 * _slope(settled, name) for name in names}
    recording, pictures = _slope(settled, "recording"), _slope(settled, "dashboard file")
    return {
        "extrapolated": seconds < 3600.0,
        "growth_mb": growth,
        "memory_mb": {name: max(one.get(name, 0.0) for one in settled) for name in names},
        "page_mb": max((one.get("page", 0.0) for one in settled), default=0.0),
        "page_growth_mb": 3000.0 * _slope(settled, "page"),
        "recording_kb_per_second": 1000.0 * recording,
        "file_rate": pictures / recording if recording > 0.0 else 0.0,
        "samples": len(settled),
        "series": list(samples[::_KEPT]),
    }


def verdict(result: Result) -> None:
    """Raises SafedpaError with everything that exceeds its limit."""
    found = [f"{name} grows by {mb:.1f} MB" for name, mb in result["growth_mb"].items() if mb > GROWTH_MB]
    found += [f"the page takes {result['page_mb']:.0f} MB"] if result["page_mb"] > PAGE_MB else []
    found += [f"the dashboard's file: {result['file_rate']:.2f}"] if result["file_rate"] > FILE_RATE else []
    summary = result["run"]
    found += [f"{one['name']} restarted" for one in summary["services"] if one["restarts"]]
    found += [f"{summary['collisions']} collisions"] if summary["collisions"] else []
    found += [f"{one['name']}: silent for {one['seconds']:.1f} s" for one in summary["incidents"]]
    if found:
        raise SafedpaError(f"soak: {'; '.join(found)}")


def report(result: Result) -> str:
    """The figures next to their limits."""
    hour = "extrapolated to an hour" if result["extrapolated"] else "measured"
    head = f"{result['robots']} robots, {result['minutes']:g} minutes; growth {hour}, {result['samples']} samples"
    lines = [head, "", "| what | memory at most | growth in 50 minutes | limit |", "|---|---|---|---|"]
    lines += [
        f"| {name} | {result['memory_mb'][name]:.0f} MB | {mb:+.1f} MB | {GROWTH_MB:g} MB |"
        for name, mb in result["growth_mb"].items()
    ]
    page = f"| page | {result['page_mb']:.0f} MB | {result['page_growth_mb']:+.1f} MB | {PAGE_MB:g} MB in all |"
    rate = f"{result['file_rate']:.2f} times the recording's {result['recording_kb_per_second']:.0f} kB/s"
    return "\n".join([*lines, page, "", f"dashboard's file: {rate}, limit {FILE_RATE:g}"])


def _slope(samples: Sequence[Sample], name: str) -> float:
    """Growth per second; 0 for fewer than two samples."""
    rows = [(one["seconds"], one[name]) for one in samples if name in one]
    times, values = zip(*rows, strict=True) if rows else ((), ())
    return float(np.polyfit(times, values, 1)[0]) if len(rows) > 1 else 0.0


def recorded(path: Path) -> list[Sample]:
    """Returns the samples that a run has written so far, to judge one that was stopped; the last line may be cut."""
    return [json.loads(line) for line in path.read_text().splitlines() if line.endswith("}")]


def _driven(
    folder: Path, seconds: float, options: Sequence[str], record: Path | None, report_progress: ReportProgress
) -> tuple[list[Sample], dict[str, Any]]:
    command = [sys.executable, "-m", "safedpa_services", "up", *options, "--out", str(folder / "runs")]
    with (folder / "output").open("wb") as output:
        running = subprocess.Popen(command, stdout=output, stderr=output)
    try:
        addresses = _addresses(folder, running)
        with _browser(addresses) as driver:
            began, samples = time.monotonic(), list[Sample]()
            while running.poll() is None and (passed := time.monotonic() - began) < seconds + _END_SECONDS:
                page = sum(map(_tree_mb, _children(driver)))
                samples.append({"seconds": passed, **_memory(running.pid), **_files(folder), "page": page})
                if record is not None:
                    with record.open("a") as file:
                        file.write(json.dumps(samples[-1]) + "\n")
                report_progress(min(int(passed), int(seconds)), int(seconds))
                time.sleep(_SAMPLE_SECONDS)
        if running.poll() is None:
            raise SafedpaError(f"soak: the run did not end {_END_SECONDS:.0f} s after its time")
        return samples[:-2], _summary(folder)  # the last samples may be of processes that end
    finally:
        if running.poll() is None:
            running.send_signal(signal.SIGINT)
            running.wait(_END_SECONDS)


def _addresses(folder: Path, running: subprocess.Popen[bytes]) -> tuple[str, ...]:
    """Returns the addresses of the dashboard and of the live page, once both are known."""
    until = time.monotonic() + _START_SECONDS
    while running.poll() is None and time.monotonic() < until:
        found = _DASHBOARD.search((folder / "output").read_text(errors="replace"))
        pages = [path.read_text().strip() for path in (folder / "runs").glob("*/page-address")]
        if found and pages:
            return found[1], pages[0]
        time.sleep(0.5)
    raise SafedpaError(f"soak: no dashboard came up: {(folder / 'output').read_text(errors='replace')[-300:]}")


@contextmanager
def _browser(addresses: Sequence[str]) -> Iterator[int]:
    """Opens the pages in a headless Chromium; yields the id of the process that drives it, which is not counted."""
    program = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if program is None:
        raise SafedpaError("soak: no Chromium; install it (Debian: apt-get install chromium)")
    from playwright.sync_api import sync_playwright

    before = set(_children(os.getpid()))
    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=program, args=list(_BROWSER))
        for address in addresses:
            _open(browser.new_page(viewport={"width": 1400, "height": 900}), address)
        (driver, *_) = set(_children(os.getpid())) - before
        yield driver
        browser.close()


def _open(page: Page, address: str) -> None:
    """Opens an address, again while its server does not accept connections: on a busy machine it may be restarting."""
    from playwright.sync_api import Error

    until = time.monotonic() + _START_SECONDS
    while True:
        try:
            page.goto(address, timeout=1e3 * _START_SECONDS)
        except Error as error:
            if "ERR_CONNECTION" not in str(error) or time.monotonic() > until:
                raise SafedpaError(f"soak: {str(error).splitlines()[0]}") from error
            time.sleep(1.0)
        else:
            return


def _summary(folder: Path) -> dict[str, Any]:
    """Returns what the summaries of all robots and the logs say of the run."""
    text = (folder / "output").read_text(errors="replace")
    robots = [json.loads(path.read_text()) for path in (folder / "runs").glob("*/robot*.json")]
    restarted = re.findall(r"^(\S+): restarted (\d+) times", text, re.MULTILINE)
    silent = re.findall(r"^(.+): silent for ([0-9.]+) s", text, re.MULTILINE)
    return {
        "ticks": sum(one["ticks"] for one in robots),
        "collisions": sum(one["collisions"] for one in robots),
        "services": [{"name": name, "restarts": int(count)} for name, count in restarted],
        "incidents": [{"name": name, "seconds": float(seconds)} for name, seconds in silent],
    }


def _children(parent: int) -> list[int]:
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            if int(path.read_text().rpartition(")")[2].split()[1]) == parent:
                found.append(int(path.parent.name))
        except OSError:  # it has ended
            continue
    return found


def _own_mb(pid: int) -> float:
    """Memory of a process without mapped files [MB]."""
    try:
        found = re.search(r"^RssAnon:\s+(\d+) kB", Path(f"/proc/{pid}/status").read_text(), re.MULTILINE)
    except OSError:
        return 0.0
    return int(found[1]) / 1000.0 if found else 0.0


def _tree_mb(pid: int) -> float:
    return _own_mb(pid) + sum(map(_tree_mb, _children(pid)))


def _memory(supervisor: int) -> Sample:
    """Memory of the supervisor and of its processes by name [MB]; of each with the processes that it started."""
    found = {"supervisor": _own_mb(supervisor)}
    for pid in _children(supervisor):
        try:
            phrase = Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace").split("\0")
        except OSError:
            continue
        module = phrase[phrase.index("-m") + 1] if "-m" in phrase else ""
        name = phrase[phrase.index("--name") + 1] if "--name" in phrase else module.rpartition(".")[2]
        if module:
            found[name] = _tree_mb(pid)
    return found


def _files(folder: Path) -> Sample:
    def megabytes(pattern: str) -> float:
        return sum(path.stat().st_size for path in (folder / "runs").glob(pattern)) / 1e6

    return {"recording": megabytes("*/recording*.mcap"), "dashboard file": megabytes("*/dashboard*.rrd")}
