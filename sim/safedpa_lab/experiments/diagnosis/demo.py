"""The demonstration in many scenes: how often does each of its steps succeed?"""

from __future__ import annotations

import datetime
import json
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from safedpa_lab.experiments.record import Options, ReportProgress, Result

_WANTED_FALL, _WANTED_WAY, _LONGEST_UNSAID = 0.6, 5.0, 10.0
"""Reduction of the error; m driven in the 20 s after the model was changed; s of standing without a message."""
_TIMEOUT = 1200.0
"""s for one drive, on a busy machine."""
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
        for drive in pool.map(partial(_drive, folder=options["recordings"]), seeds):
            drives.append(drive)
            report_progress(len(drives), len(seeds))
    return {
        "experiment": "demo",
        "date": datetime.date.today().isoformat(),
        "seeds": [seeds.start, seeds.stop - 1],
        "alongside": options["parallel"],
        "busy": options["busy"],
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


def _drive(seed: int, folder: Path) -> dict[str, Any]:
    command = [sys.executable, "-m", "safedpa_services", "demo", "--yes", "--headless", "--json"]
    command += ["--seed", str(seed), "--out", str(folder)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_TIMEOUT, check=False)
        return judged(json.loads(done.stdout))
    except subprocess.TimeoutExpired:
        failure = f"not over after {_TIMEOUT:.0f} s"
    except json.JSONDecodeError:
        failure = done.stderr.strip().splitlines()[-1][:300] if done.stderr.strip() else "no output"
    return {"seed": seed, "failure": failure, **dict.fromkeys(_STEPS, False)}


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
