"""Two checkouts side by side: short drives in turn, so that what the machine does meanwhile happens to both.

A drive of one checkout is followed by one of the other, and the order changes from pair to pair. Each pair gives one
ratio; the reported value is the median of them, and an interval that holds the true median with 95 % whatever the
distribution is (the order statistics of the sign test).
"""

from __future__ import annotations

import json
import math
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from safedpa.errors import InputError, SafedpaError
from safedpa_lab.benchmarks.usage import load_average

FIGURES: Final = {
    "sense to act, p50": "us",
    "sense to act, p99": "us",
    "start to the first action": "s",
    "processor time of start and drive": "s",
}
"""What one drive gives, with units. Other work changes times of the wall; that of the processor hardly."""
_ROOMS: Final = ("shared", "services", "sim")
_COVERAGE: Final = 0.95
_LONGEST_SECONDS: Final = 180.0
"""Beyond the drive itself, until a run is given up."""
_LONGEST_BENCH: Final = 1800.0

Drive = Callable[[Path], Mapping[str, float]]


def checkout_of(folder: Path) -> Path:
    """The folder, if it holds the packages of this project. Raises InputError when it does not."""
    absent = [name for name in _ROOMS if not (folder / name).is_dir()]
    if absent or not (folder / "shared" / "safedpa" / "__init__.py").is_file():
        raise InputError(f"{folder}: got no {', '.join(absent) or 'shared/safedpa'}; wanted a checkout of this project")
    return folder.resolve()


def interval_of_median(values: Sequence[float]) -> tuple[float, float]:
    """Two of the values between which the true median lies with at least 95 %; of fewer than six the least and most."""
    ordered, most = sorted(values), (1.0 - _COVERAGE) / 2.0
    below, rank = 0.0, 0
    while rank < len(ordered) // 2:
        below += math.comb(len(ordered), rank) / 2.0 ** len(ordered)
        if below > most:
            break
        rank += 1
    return ordered[max(rank - 1, 0)], ordered[len(ordered) - max(rank, 1)]


def against(
    ours: Path,
    other: Path,
    pairs: int,
    seconds: float,
    report_progress: Callable[[int, int], None] = lambda _done, _all: None,
    drive: Drive | None = None,
    rows: Sequence[str] = (),
) -> dict[str, Any]:
    """Drives both in turn, ``pairs`` times, after one of each that is not counted; with ``rows`` measures those.

    Ratios are ours over the other's, of the figures that both have. Raises SafedpaError when a drive fails.
    """
    before = load_average()
    found: tuple[list[Mapping[str, float]], list[Mapping[str, float]]] = ([], [])
    with tempfile.TemporaryDirectory(prefix="safedpa-against-", ignore_cleanup_errors=True) as compiled:
        run = drive or (
            lambda folder: benched(folder, rows, Path(compiled)) if rows else driven(folder, seconds, Path(compiled))
        )
        for number in range(pairs + 1):
            for which in (0, 1) if number % 2 else (1, 0):
                measured = run((ours, other)[which])
                if number:
                    found[which].append(measured)
            report_progress(number, pairs)
    return {
        "pairs": pairs,
        "seconds": seconds,
        "figures": {name: _compared(name, *found) for name in found[0][0] if name in found[1][0]},
        "load_average": [before, load_average()],
    }


def _compared(name: str, ours: Sequence[Mapping[str, float]], others: Sequence[Mapping[str, float]]) -> dict[str, Any]:
    ratios = [mine[name] / other[name] for mine, other in zip(ours, others, strict=True)]
    low, high = interval_of_median(ratios)
    return {
        "unit": FIGURES.get(name) or name.rpartition(" ")[2].strip("[]"),
        "ours": round(statistics.median(entry[name] for entry in ours), 4),
        "other": round(statistics.median(entry[name] for entry in others), 4),
        "ratio": round(statistics.median(ratios), 4),
        "interval": [round(low, 4), round(high, 4)],
        "ratios": [round(ratio, 4) for ratio in ratios],
    }


def driven(folder: Path, seconds: float, compiled: Path) -> dict[str, float]:
    """One ``safedpa up`` of a checkout in real time, with this Python and what is installed in it.

    Modules are compiled once, into the folder ``compiled``, as for what is installed: otherwise the start would tell
    how many lines of source there are.
    """
    with tempfile.TemporaryDirectory() as out:
        drive = ["up", "--headless", "--json", "--load", "box", "--seconds", repr(seconds), "--out", out]
        began, used = time.time(), _processor_seconds()
        summary = json.loads(_message_by(folder, drive, Path(out), compiled, seconds + _LONGEST_SECONDS))
        first = first_action(Path(summary["recording"])) - began
    latency, used = summary["latency_us"], _processor_seconds() - used
    return dict(zip(FIGURES, (latency["p50"], latency["p99"], first, used), strict=True))


def _processor_seconds() -> float:
    """Returns the processor time of all processes that this one has waited for, with those that they waited for."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def benched(folder: Path, rows: Sequence[str], compiled: Path) -> dict[str, float]:
    """Rows of ``safedpa bench all --quick`` of a checkout: the median of each, in time of the processor where
    reported."""
    with tempfile.TemporaryDirectory() as out:
        file = Path(out) / "rows.json"
        named = [part for name in rows for part in ("--only", name)]
        _message_by(
            folder, ["bench", "all", "--quick", *named, "--json", str(file)], Path(out), compiled, _LONGEST_BENCH
        )
        document = json.loads(file.read_text(encoding="utf-8"))
    found = {}
    for name in rows:
        for measured in document["rows"][name]["ours"]:
            figures = {**measured["figures"], **measured["processor"]}
            key = next((key for key in ("p50", "seconds") if key in figures), None)
            if key is not None:
                parts = [name, measured["name"].removeprefix("safedpa, "), measured["problem"]]
                found[f"{', '.join(filter(None, parts))} [{measured['unit']}]"] = float(figures[key])
    return found


def _message_by(folder: Path, arguments: Sequence[str], where: Path, compiled: Path, longest_seconds: float) -> str:
    """What ``safedpa`` of a checkout writes. Raises SafedpaError when it fails or takes longer."""
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(str(folder / name) for name in _ROOMS),
        "PYTHONPYCACHEPREFIX": str(compiled),
    }
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    command = [sys.executable, "-m", "safedpa_services", *arguments]
    notice = f"{folder}: safedpa {' '.join(arguments[:2])}"
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, check=False, cwd=where, env=environment, timeout=longest_seconds
        )
    except subprocess.TimeoutExpired as error:
        raise SafedpaError(f"{notice} did not end within {error.timeout:.0f} s") from error
    if done.returncode != 0:
        raise SafedpaError(f"{notice}: {done.stderr.strip()[-500:]}")
    return done.stdout


def first_action(recording: Path) -> float:
    """s of the wall clock; when the first action was published, whatever else a message of that version holds."""
    import msgpack
    from mcap.reader import make_reader

    with recording.open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages():
            if channel.topic.endswith("/action"):
                return float(msgpack.unpackb(message.data)["publish_time"])
    raise SafedpaError(f"{recording}: got no action, wanted some; the loop did not begin")
