"""Start to the first tick, imports, and memory of each process."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, Final

from safedpa.errors import SafedpaError
from safedpa_lab.benchmarks.results import Effort, Entry, Row, Target
from safedpa_lab.benchmarks.usage import usage_of

__all__ = ["measure"]

_SERVICES: Final = ("adaptation", "policy", "safety_filter", "recorder", "diagnosis", "dashboard")
_LOOK_SECONDS = 0.2
_DRIVEN_SECONDS = 3.0
_IMPORT = """
import sys, time
began = time.perf_counter()
import {module}
print(time.perf_counter() - began, "torch" in sys.modules)
"""


def measure(effort: Effort) -> Row:
    """``safedpa up`` a few times, and every service imported a few times in a fresh Python; the median of each."""
    times, memory = zip(*(_started() for _ in range(effort.of(1, 5))), strict=True)
    first = _median(list(times))
    imports = {name: _imported(f"safedpa_services.{name}.__main__", effort.of(1, 5)) for name in _SERVICES}
    notes = tuple(f"the import of {name} brings torch" for name, (_, torch) in imports.items() if torch)
    ours = [Entry("safedpa up to the first action", {"seconds": first}, "s", problem="start")]
    ours += [
        Entry(
            f"import of {name}", {"seconds": seconds}, "s", problem="import", note="without torch" if not torch else ""
        )
        for name, (seconds, torch) in imports.items()
    ]
    largest = {name: max(known.get(name, 0.0) for known in memory) for known in memory for name in known}
    ours += [Entry(f"memory of {name}", {"mib": mib}, "", problem="memory") for name, mib in sorted(largest.items())]
    slowest = max(seconds for seconds, _ in imports.values())
    targets = (
        Target("start to the first tick", 5.0, first, "s"),
        Target("import of the slowest service", 0.7, slowest, "s"),
    )
    work = "start of `safedpa up` to the first tick; import time and memory of each process"
    return Row("start", work, "seconds", tuple(ours), targets=targets, notes=notes)


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
        out, words = process.communicate()
        if process.returncode != 0:
            raise SafedpaError(f"safedpa up: {words.strip()}")
        return _first_action(Path(json.loads(out)["recording"])) - began, memory


def _children(parent: int) -> dict[int, str]:
    """Processes that ``parent`` started, by the module they run; none where the system has no /proc."""
    found = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            above = int((folder / "stat").read_text(encoding="utf-8").rsplit(")", 1)[1].split()[1])
            words = (folder / "cmdline").read_text(encoding="utf-8").split("\0")
        except (OSError, IndexError, ValueError):
            continue
        if above == parent and "-m" in words:
            module = words[words.index("-m") + 1]
            if module == "safedpa_services":  # a child that has not become its program yet
                continue
            found[int(folder.name)] = module.removeprefix("safedpa_services.").removeprefix("safedpa_sim.")
    return found


def _first_action(recording: Path) -> float:
    """When the first action was published, in seconds of the wall clock."""
    from mcap.reader import make_reader

    from safedpa.bus.wire.codec import decode
    from safedpa.bus.wire.messages import ActionMessage

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
