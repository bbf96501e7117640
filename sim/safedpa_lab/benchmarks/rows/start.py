"""Start to the first tick and to the first page, imports, a comparison, and memory of each process."""

from __future__ import annotations

import json
import queue
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from statistics import median
from typing import IO, Any, Final
from urllib.request import HTTPCookieProcessor, ProxyHandler, build_opener

from safedpa.errors import SafedpaError
from safedpa_lab.benchmarks.against import first_action
from safedpa_lab.benchmarks.results import Effort, Entry, Floor, Row, Target, missing
from safedpa_lab.benchmarks.usage import output_of, usage_of
from safedpa_services.workbench.screenshots import find_browser, take_screenshot

_PATIENCE_SECONDS: Final = 60.0
_PAGE_LOOK_SECONDS: Final = 0.02
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
            reported |= {page.strip(): _address(notice.removeprefix(page)) for page in pages if notice.startswith(page)}
        for page, address in reported.items():
            if page not in found and answers(address):
                found[page] = time.monotonic() - began
        if process.poll() is not None:
            raise SafedpaError(f"safedpa up: ended with exit code {process.returncode}: {notice.strip()}")
        if time.monotonic() - began > _PATIENCE_SECONDS:
            absent = ", ".join(page.strip() for page in pages if page.strip() not in found)
            raise SafedpaError(f"safedpa up: no answer of {absent} within {_PATIENCE_SECONDS:.0f} s")
        time.sleep(_PAGE_LOOK_SECONDS)
    return found


def seconds_to_first_frame() -> float:
    """Seconds from ``safedpa demo`` until a browser has drawn its page with the values of a robot.

    Raises SafedpaError without Chromium, or where the demonstration ends before that.
    """
    find_browser()  # before the clock begins
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "safedpa_services", "demo", "--yes", "--no-browser", "--out", folder]
        began = time.monotonic()
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            while not (found := [path.read_text(encoding="utf-8") for path in Path(folder).glob("*/page-address")]):
                if process.poll() is not None or time.monotonic() - began > _PATIENCE_SECONDS:
                    raise SafedpaError(f"safedpa demo: no page within {_PATIENCE_SECONDS:.0f} s")
                time.sleep(_PAGE_LOOK_SECONDS)
            take_screenshot(found[0].strip(), Path(folder) / "first.png")
            return time.monotonic() - began
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(2.0 * _END_SECONDS)


def _address(text: str) -> str:
    """The address in a line of ``safedpa up``; in a pipe, the one with the token is in a file that the line names."""
    _, mark, rest = text.partition(" is in ")
    return Path(rest.partition(", for")[0]).read_text(encoding="utf-8").strip() if mark else text.strip()


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


_SERVICES: Final = ("adaptation", "policy", "safety_filter", "recorder", "diagnosis", "dashboard")
_ACTING: Final = ("adaptation", "policy", "safety_filter")
"""Without these there is no action."""
_LOOK_SECONDS = 0.2
_DRIVEN_SECONDS = 3.0
_RECORDED_SECONDS: Final = 20.0
_IMPORT = """
import sys, time
began = time.perf_counter()
import {module}
print(time.perf_counter() - began, "torch" in sys.modules)
"""


def measure(effort: Effort) -> Row:
    """``safedpa up`` a few times, and every service imported a few times in a fresh Python; the median of each."""
    times = effort.of(1, 5)
    starts, memory = zip(*(_started() for _ in range(times)), strict=True)
    first = median(list(starts))
    shown = [seconds_to_pages() for _ in range(times)]
    pages = {page: median([each[page] for each in shown]) for page in shown[0]}
    imports = {name: _imported(f"safedpa_services.{name}.__main__", times) for name in _SERVICES}
    alone, numpy = (_imported(name, times)[0] for name in ("safedpa", "numpy"))
    compared = _compared(times)
    ours = [Entry("safedpa up to the first action", {"seconds": first}, "s", problem="start")]
    ours += [
        Entry(
            f"safedpa up to the {page}", {"seconds": seconds}, "s", problem="start", note="until it answers over HTTP"
        )
        for page, seconds in pages.items()
    ]
    frame = _first_frame()
    ours.append(frame)
    note = f"a drive of {_RECORDED_SECONDS:g} s, from the command to its page and document"
    ours.append(Entry("safedpa compare", {"seconds": compared}, "s", problem="start", note=note))
    ours += _import_entries(imports, alone)
    largest = {name: max(known.get(name, 0.0) for known in memory) for known in memory for name in known}
    ours += [Entry(f"memory of {name}", {"mib": mib}, "", problem="memory") for name, mib in sorted(largest.items())]
    needed, dashboard = max(_ACTING, key=lambda name: imports[name][0]), imports["dashboard"][0]
    targets = (
        *([] if frame.missing else [Target("demo to the first frame", 20.0, frame.figures["seconds"], "s")]),
        Target("start to the first action", 2.0, first, "s", floor=Floor(f"import of {needed}", imports[needed][0])),
        Target("start to the live view", 4.0, pages["live view"], "s", floor=Floor("import of dashboard", dashboard)),
        Target("safedpa compare of a recording", 2.0, compared, "s", floor=Floor("import of numpy", numpy)),
        Target("import safedpa", 0.15, alone, "s"),
    )
    notes = tuple(f"the import of {name} brings torch" for name, (_, torch) in imports.items() if torch)
    work = "start of `safedpa up` to the first tick and page; a comparison; import time and memory of each process"
    return Row("start", work, "seconds", tuple(ours), targets=targets, notes=notes)


def _first_frame() -> Entry:
    name = "safedpa demo to the first frame"
    try:
        return Entry(name, {"seconds": seconds_to_first_frame()}, "s", problem="start", note="drawn in Chromium")
    except SafedpaError as error:
        return missing(name, str(error), "start")


def _import_entries(imports: Mapping[str, tuple[float, bool]], alone: float) -> list[Entry]:
    found = [Entry("import safedpa", {"seconds": alone}, "s", problem="import", note="what it offers comes when asked")]
    for name, (seconds, torch) in imports.items():
        note = "" if torch else "without torch"
        found.append(Entry(f"import of {name}", {"seconds": seconds}, "s", problem="import", note=note))
    return found


def _compared(times: int) -> float:
    """Median seconds of ``safedpa compare`` by the clock, of a drive that is recorded for it in lockstep, seed 0."""
    with tempfile.TemporaryDirectory() as folder:
        drive = ["up", "--headless", "--json", "--lockstep", "--seconds", repr(_RECORDED_SECONDS), "--out", folder]
        recording = json.loads(output_of(*drive))["recording"]
        found = []
        for number in range(times):
            report = str(Path(folder) / f"report {number}")
            began = time.perf_counter()
            output_of("compare", "car", recording, "--json", "--out", report)
            found.append(time.perf_counter() - began)
    return median(found)


def _started() -> tuple[float, dict[str, float]]:
    """Seconds from the command to the first action on the bus, as it was recorded, and MiB of each process."""
    memory: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "safedpa_services", "up", "--headless", "--json", "--out", folder]
        began = time.time()
        process = subprocess.Popen(
            [*command, "--seconds", repr(_DRIVEN_SECONDS)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        while process.poll() is None:
            for pid, name in _children(process.pid).items():
                used = usage_of(pid)
                memory[name] = max(memory.get(name, 0.0), used.resident_mib if used else 0.0)
            time.sleep(_LOOK_SECONDS)
        out, phrase = process.communicate()
        if process.returncode != 0:
            raise SafedpaError(f"safedpa up: {phrase.strip()}")
        return first_action(Path(json.loads(out)["recording"])) - began, memory


def _children(parent: int) -> dict[int, str]:
    """Processes that ``parent`` started, by the module they run; none where the system has no /proc."""
    found = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            above = int((folder / "stat").read_text(encoding="utf-8").rsplit(")", 1)[1].split()[1])
            phrase = (folder / "cmdline").read_text(encoding="utf-8").split("\0")
        except (OSError, IndexError, ValueError):
            continue
        if above == parent and "-m" in phrase:
            module = phrase[phrase.index("-m") + 1]
            if module == "safedpa_services":  # a child that has not become its program yet
                continue
            found[int(folder.name)] = module.removeprefix("safedpa_services.").removeprefix("safedpa_sim.")
    return found


def _imported(module: str, times: int) -> tuple[float, bool]:
    """Median seconds of an import in a fresh Python, and whether torch came with it."""
    found: list[Any] = []
    for _ in range(times):
        command = [sys.executable, "-c", _IMPORT.format(module=module)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise SafedpaError(f"import of {module}: {done.stderr.strip()}")
        found.append(done.stdout.split()[-2:])
    return median([float(seconds) for seconds, _ in found]), any(torch == "True" for _, torch in found)
