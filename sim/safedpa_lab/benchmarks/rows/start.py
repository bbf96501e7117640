"""Start to the first tick and to the first page, imports, a comparison, and memory of each process."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from safedpa.errors import SafedpaError
from safedpa_lab.benchmarks.first_page import seconds_to_pages
from safedpa_lab.benchmarks.results import Effort, Entry, Floor, Row, Target
from safedpa_lab.benchmarks.usage import usage_of

__all__ = ["measure"]

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
    first = _median(list(starts))
    shown = [seconds_to_pages() for _ in range(times)]
    pages = {page: _median([each[page] for each in shown]) for page in shown[0]}
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
    note = f"a drive of {_RECORDED_SECONDS:g} s, from the command to its page and document"
    ours.append(Entry("safedpa compare", {"seconds": compared}, "s", problem="start", note=note))
    ours += _import_entries(imports, alone)
    largest = {name: max(known.get(name, 0.0) for known in memory) for known in memory for name in known}
    ours += [Entry(f"memory of {name}", {"mib": mib}, "", problem="memory") for name, mib in sorted(largest.items())]
    needed, dashboard = max(_ACTING, key=lambda name: imports[name][0]), imports["dashboard"][0]
    targets = (
        Target("start to the first action", 2.0, first, "s", floor=Floor(f"import of {needed}", imports[needed][0])),
        Target("start to the live view", 4.0, pages["live view"], "s", floor=Floor("import of dashboard", dashboard)),
        Target("safedpa compare of a recording", 2.0, compared, "s", floor=Floor("import of numpy", numpy)),
        Target("import safedpa", 0.15, alone, "s"),
    )
    notes = tuple(f"the import of {name} brings torch" for name, (_, torch) in imports.items() if torch)
    work = "start of `safedpa up` to the first tick and page; a comparison; import time and memory of each process"
    return Row("start", work, "seconds", tuple(ours), targets=targets, notes=notes)


def _import_entries(imports: Mapping[str, tuple[float, bool]], alone: float) -> list[Entry]:
    found = [Entry("import safedpa", {"seconds": alone}, "s", problem="import", note="what it offers comes when asked")]
    for name, (seconds, torch) in imports.items():
        note = "" if torch else "without torch"
        found.append(Entry(f"import of {name}", {"seconds": seconds}, "s", problem="import", note=note))
    return found


def _compared(times: int) -> float:
    """Median seconds of ``safedpa compare`` by the clock, of a drive that is recorded for it in lockstep, seed 0."""
    safedpa = [sys.executable, "-m", "safedpa_services"]
    with tempfile.TemporaryDirectory() as folder:
        drive = ["up", "--headless", "--json", "--lockstep", "--seconds", repr(_RECORDED_SECONDS), "--out", folder]
        recording = json.loads(_message([*safedpa, *drive]))["recording"]
        found = []
        for number in range(times):
            report = str(Path(folder) / f"report {number}")
            began = time.perf_counter()
            _message([*safedpa, "compare", "car", recording, "--json", "--out", report])
            found.append(time.perf_counter() - began)
    return _median(found)


def _message(command: list[str]) -> str:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise SafedpaError(f"{' '.join(command[2:5])}: {done.stderr.strip()}")
    return done.stdout


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
        return _first_action(Path(json.loads(out)["recording"])) - began, memory


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


def _first_action(recording: Path) -> float:
    """When the first action was published, in seconds of the wall clock."""
    from mcap.reader import make_reader

    from safedpa.bus.messages.codec import decode
    from safedpa.bus.messages.messages import ActionMessage

    with recording.open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages():
            if channel.topic.endswith("/action"):
                return float(decode(ActionMessage, message.data).publish_time)
    raise SafedpaError(f"{recording}: got no action, wanted some; the loop did not begin")


def _imported(module: str, times: int) -> tuple[float, bool]:
    """Median seconds of an import in a fresh Python, and whether torch came with it."""
    found: list[Any] = []
    for _ in range(times):
        command = [sys.executable, "-c", _IMPORT.format(module=module)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise SafedpaError(f"import of {module}: {done.stderr.strip()}")
        found.append(done.stdout.split()[-2:])
    return _median([float(seconds) for seconds, _ in found]), any(torch == "True" for _, torch in found)


def _median(values: list[float]) -> float:
    return sorted(values)[len(values) // 2]
