"""Logs of hours with one effect hidden in them, by the simulator that shares no code with the fitted models."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.bus.messages.codec import encode
from safedpa.bus.messages.messages import StateMessage
from safedpa.bus.messages.topics import STATE, key_of
from safedpa.errors import SafedpaError
from safedpa.records import McapRecorder
from safedpa.records.writers.tables import write_columns
from safedpa.robots.car.system import CAR
from safedpa_lab.experiments.record import Options, ReportProgress, Result, silent
from safedpa_lab.experiments.report import markdown_table
from safedpa_lab.hidden.car import ACCELERATION_LIMIT, WHEELBASE, simulate_cars
from safedpa_lab.hidden.case import LARGEST_STEER, Effects
from safedpa_lab.hidden.lanes import Lane, car_commands
from safedpa_lab.hidden.write import measured

HIDDEN: Final[Effects] = {"quadratic_drag": {"coefficient": 0.12}}
KINDS: Final = ("csv", "parquet", "mcap")
_GAIN = 3.0
"""1/s of the speed servo, in the car and in the given model."""
_SITTING, _PAUSE = 300.0, 5.0
"""s; after so long the car is carried back to its start, which takes so long. All sittings are integrated at once."""


@dataclass(frozen=True)
class LongLogs:
    """How many logs of how many seconds, at how many seconds between rows, with what hidden."""

    runs: int = 10
    seconds: float = 3600.0
    period: float = 0.01
    effects: Effects = field(default_factory=lambda: HIDDEN)
    seed: int = 0


def write_long_logs(
    logs: LongLogs, folder: Path, kinds: tuple[str, ...] = ("csv",), report_progress: ReportProgress = silent
) -> dict[str, list[Path]]:
    """Writes ``model.toml``, which knows nothing of what is hidden, and the runs in each kind of file; their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "model.toml").write_text(_model(logs.period), encoding="utf-8")
    found: dict[str, list[Path]] = {kind: [] for kind in kinds}
    sittings = max(1, round(logs.seconds / _SITTING))
    lanes = [
        _lane(logs, run, number, logs.seconds / sittings) for run in range(logs.runs) for number in range(sittings)
    ]
    done = simulate_cars(lanes, logs.period)
    for run in range(logs.runs):
        own = slice(run * sittings, (run + 1) * sittings)
        states, actions = np.concatenate(done.states[own]), np.concatenate(done.actions[own])
        shown, _ = measured(states, "car", np.random.default_rng([logs.seed, run, 1]), False)
        pauses = np.repeat(_PAUSE * np.arange(sittings), len(states) // sittings)
        t = np.asarray(logs.period * np.arange(len(states)) + pauses, dtype=np.float64)
        for kind in kinds:
            path = folder / f"run_{run + 1}.{kind}"
            _write(path, kind, t, shown, actions)
            found[kind].append(path)
        report_progress(run + 1, logs.runs)
    return found


def _lane(logs: LongLogs, run: int, sitting: int, seconds: float) -> Lane:
    random = np.random.default_rng([logs.seed, run, 0, sitting])
    rows = round(seconds / logs.period)
    start = (*random.uniform(-2.0, 2.0, 2), random.uniform(-3.0, 3.0), random.uniform(0.0, 1.0))
    commands = car_commands(random, rows, logs.period, LARGEST_STEER)
    return Lane(logs.effects, commands, tuple(float(value) for value in start), _GAIN)


def _write(path: Path, kind: str, t: FloatArray, states: FloatArray, actions: FloatArray) -> None:
    if kind == "mcap":
        _write_recording(path, t, states, actions)
        return
    columns = {"t": t, **dict(zip(CAR.state_names, states.T, strict=True))}
    write_columns({**columns, **dict(zip(CAR.action_names, actions.T, strict=True))}, path, kind)


def _write_recording(path: Path, t: FloatArray, states: FloatArray, actions: FloatArray) -> None:
    """The states as the robot publishes them, each with the action of the period before it."""
    path.unlink(missing_ok=True)  # a recorder overwrites nothing
    key = key_of("fleet", "car1", STATE)
    with McapRecorder(path) as recorder:
        for tick, (now, values) in enumerate(zip(t.tolist(), states.tolist(), strict=True)):
            message = StateMessage(
                epoch=1,
                tick=tick,
                robot_time=now,
                publish_time=now,
                values=tuple(values),
                applied=tuple(actions[tick - 1].tolist()) if tick else (),
                applied_by="filter" if tick else "none",
                period=float(t[1] - t[0]),
                lockstep=False,
                goal=(1.0, 1.0),
                obstacles=((2.0, 1.0, 0.3),) * 8,
                field=(-6.0, 6.0, -6.0, 6.0),
                footprint=(0.08, 0.4, 0.12),
            )
            stamp = round(1e9 * now)
            recorder.write(key, encode(message), stamp, stamp)


def _model(period: float) -> str:
    lines = ["format = 1", 'robot = "car"', f"period = {period}", "", "[base]", 'kind = "kinematic_bicycle"']
    lines += ['drive = "speed_servo"', f"wheelbase = {WHEELBASE}", f"speed_gain = {_GAIN}"]
    return "\n".join([*lines, f"acceleration_limit = {ACCELERATION_LIMIT}"]) + "\n"


def run(options: Options, report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment long-logs``: measures time and memory of each command as a process."""
    kinds = options["kinds"] or ("csv",)
    logs = LongLogs(options["runs"], options["seconds"], options["period"], seed=options["seed"])
    with tempfile.TemporaryDirectory(prefix="safedpa-long-") as name:
        folder = Path(name)
        paths = write_long_logs(logs, folder, kinds, report_progress)
        rows = [_measured(folder, kind, paths[kind], what) for kind in kinds for what in ("diagnose", "compare")]
    shape = {key: options[key] for key in ("runs", "seconds", "period", "seed")}
    return {"experiment": "long-logs", **shape, "hidden": dict(HIDDEN), "rows": rows}


def _measured(folder: Path, kind: str, paths: list[Path], what: str) -> dict[str, Any]:
    """Runs one command on the files. Raises SafedpaError when it fails."""
    arguments = [what, str(folder / "model.toml"), *map(str, paths), "--out", str(folder / kind), "--json"]
    begin = time.perf_counter()
    with (folder / "answer.json").open("wb") as answer, (folder / "errors.txt").open("wb") as errors:
        process = subprocess.Popen([sys.executable, "-m", "safedpa_services", *arguments], stdout=answer, stderr=errors)
        _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SafedpaError(f"{what} of {kind}: {(folder / 'errors.txt').read_text(encoding='utf-8').strip()}")
    document = json.loads((folder / "answer.json").read_text(encoding="utf-8"))
    return {
        "kind": kind,
        "command": what,
        "megabytes_read": round(sum(path.stat().st_size for path in paths) / 1e6, 1),
        "seconds": round(time.perf_counter() - begin, 1),
        "processor_seconds": round(usage.ru_utime + usage.ru_stime, 1),
        "memory_mebibytes": round(usage.ru_maxrss / 1024),
        "added": document.get("added"),
        "parameters": document.get("parameters"),
    }


def report(result: Result) -> str:
    """One row per kind of file and command."""
    return markdown_table(
        "files | command | MB read | s | s of processor | MiB at most | added",
        (
            f"{row['kind']} | {row['command']} | {row['megabytes_read']} | {row['seconds']} "
            f"| {row['processor_seconds']} | {row['memory_mebibytes']} | {', '.join(row['added'] or ())}"
            for row in result["rows"]
        ),
    )
