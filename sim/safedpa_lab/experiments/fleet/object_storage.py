"""Many small logs in a local S3-compatible store, diagnosed by Ray workers of which one is killed, then resumed."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from io import StringIO
from pathlib import Path
from typing import Any, Final

import numpy as np

from safedpa.errors import SafedpaError
from safedpa.extras import need
from safedpa.records.store import find_files, read_files
from safedpa_lab.experiments.record import Options, ReportProgress, Result

MOST_MEBIBYTES: Final = 500
"""Largest memory of a worker."""
_LOGS, _OUT = "s3://safedpa-fleet/logs", "s3://safedpa-fleet/out"
_KINDS = 20
"""Different logs, which the robots share: writing a log must not take longer than reading it."""
_BROKEN_EVERY = 50
_LONG_EVERY = 50
"""One log in so many is long enough for a diagnosis; the others measure the reading and the results of a robot."""
_SHORT_SECONDS = 1.0
_LOOK_SECONDS = 0.5
_LOOK_SHARE = 0.05
"""Most of the time that looking at the results takes: a list of ten thousand robots keeps the store busy."""
_UPLOADED_AT_ONCE = 500


def run(options: Options, report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment object-storage``."""
    need("cluster", "remote", what="object-storage")
    logs: int = options["logs"]
    with tempfile.TemporaryDirectory(prefix="safedpa-s3-") as name, _store(Path(name)) as environment:
        broken = _upload(logs, options["seconds"], options["seed"])
        begin = time.perf_counter()
        killed = _killed_diagnosis(logs, environment, lambda done: report_progress(done, logs))
        before, undelivered = _current()
        document = _diagnosis(environment)
        report_progress(logs, logs)
        seconds = time.perf_counter() - begin
        results = _results()
    return {
        "experiment": "object-storage",
        "logs": logs,
        "seconds_of_a_long_log": options["seconds"],
        "seed": options["seed"],
        "broken": broken,
        "worker_killed": killed["worker"],
        "done_when_the_command_was_killed": before,
        "not_delivered_by_the_store_before": undelivered,
        "diagnosed_by_the_second_run": document["diagnosed_now"],
        "results": len(results),
        "robots_in_the_document": len(document["robots"]),
        "complete": len(results) == logs == len(document["robots"]),
        "statuses": dict(Counter(_status(result) for result in results)),
        "processor_seconds_of_a_diagnosis": round(_mean_seconds(results, ("diagnosed", "no_verdict")), 3),
        "processor_seconds_of_the_others": round(_mean_seconds(results, ("too_short", "unreadable")), 3),
        "most_mebibytes_of_a_worker": max(result["memory_mebibytes"] for result in results),
        "most_mebibytes_of_the_command": max(killed["command"], document["command_mebibytes"]),
        "seconds": round(seconds, 1),
        "load": round(os.getloadavg()[0], 1),
    }


def report(result: Result) -> str:
    """One line for each figure."""
    shown = {name: value for name, value in result.items() if name not in ("experiment", "format")}
    return "\n".join(["| figure | value |", "|---|---|", *(f"| {name} | {value} |" for name, value in shown.items())])


def verdict(result: Result) -> None:
    """Raises SafedpaError with everything that went wrong."""
    found = [] if result["complete"] else ["robots are missing"]
    found += [] if result["worker_killed"] else ["no worker was killed"]
    repeated = result["done_when_the_command_was_killed"] + result["diagnosed_by_the_second_run"] - result["logs"]
    found += [f"{repeated} robots were diagnosed twice"] if repeated > 0 else []
    lost = result["statuses"].get("unreadable", 0)
    found += [f"{lost} unreadable, wanted {result['broken']}"] if lost != result["broken"] else []
    found += [f"{result['statuses']['failed']} failed"] if "failed" in result["statuses"] else []
    if result["most_mebibytes_of_a_worker"] >= MOST_MEBIBYTES:
        found.append(f"a worker had {result['most_mebibytes_of_a_worker']} MiB")
    if found:
        raise SafedpaError(f"object-storage: {'; '.join(found)}")


@contextmanager
def _store(folder: Path) -> Iterator[dict[str, str]]:
    """Starts moto's S3 server in a process of its own; yields the environment of its clients."""
    import fsspec

    code = (
        "import sys, time; from moto.server import ThreadedMotoServer; server = ThreadedMotoServer('127.0.0.1', 0); "
        "server.start(); print(server.get_host_and_port()[1], flush=True); sys.stdin.read()"
    )
    with (folder / "server.log").open("wb") as log:
        server = subprocess.Popen(
            [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, text=True
        )
    assert server.stdout is not None
    try:
        lines = iter(server.stdout.readline, "")
        port = next((line.strip() for line in lines if line.strip().isdigit()), None)
        if port is None:
            raise SafedpaError("object-storage: no S3 server starts; wanted pip install moto flask flask-cors s3fs")
        own = {
            "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}",
            "AWS_ACCESS_KEY_ID": "of-the-experiment",
            "AWS_SECRET_ACCESS_KEY": "of-the-experiment",
            "AWS_DEFAULT_REGION": "us-east-1",
        }
        before = dict(os.environ)
        os.environ.update(own)
        try:
            yield own
        finally:
            os.environ.clear()
            os.environ.update(before)
            fsspec.get_filesystem_class("s3").clear_instance_cache()  # it would ask the store that ends here
    finally:
        server.kill()
        server.wait()


def _upload(logs: int, seconds: float, seed: int) -> int:
    """Writes the logs, of which some are no tables; returns the number of those."""
    import fsspec

    store = fsspec.filesystem("s3")
    store.mkdir(_LOGS.split("/")[2])
    short, long = ([_log(length, np.random.default_rng([seed, number])) for number in range(_KINDS)]
                   for length in (_SHORT_SECONDS, seconds))  # fmt: skip

    def content(number: int) -> bytes:
        if number % _BROKEN_EVERY == 1:
            return b"this is no log\n1\n"
        return long[number // _LONG_EVERY % _KINDS] if number % _LONG_EVERY == 0 else short[number % _KINDS]

    for first in range(0, logs, _UPLOADED_AT_ONCE):
        numbers = range(first, min(first + _UPLOADED_AT_ONCE, logs))
        store.pipe({f"{_LOGS}/r{number:05d}/drive.csv": content(number) for number in numbers})
    return sum(number % _BROKEN_EVERY == 1 for number in range(logs))


def _log(seconds: float, random: np.random.Generator) -> bytes:
    """Returns a car on a bend at a speed that varies, as CSV at 20 Hz."""
    t = 0.05 * np.arange(max(2, round(seconds / 0.05)))
    steer = 0.2 * np.sin(t + random.uniform(0.0, 6.0))
    speed = 1.0 + 0.3 * np.sin(0.7 * t + random.uniform(0.0, 6.0))
    yaw = np.cumsum(0.05 * speed * np.tan(steer) / 0.3)
    x, y = np.cumsum(0.05 * speed * np.cos(yaw)), np.cumsum(0.05 * speed * np.sin(yaw))
    text = StringIO()
    columns = np.column_stack([t, x, y, yaw, speed, speed, steer])
    np.savetxt(text, columns, "%.6f", ",", header="t,x,y,yaw,speed,target_speed,steer", comments="")
    return text.getvalue().encode()


def _command() -> list[str]:
    options = ["--fleet", _LOGS, "--out", _OUT, "--jobs", "2", "--json", "--ray"]
    return [sys.executable, "-m", "safedpa_services", "diagnose", "car", *options]


def _killed_diagnosis(logs: int, environment: Mapping[str, str], done: Any) -> dict[str, Any]:
    """Kills a worker after a sixth of the robots, and the command after half of them."""
    running = subprocess.Popen(_command(), stdout=subprocess.DEVNULL, start_new_session=True)
    worker, most = False, 0
    try:
        while running.poll() is None:
            begin = time.monotonic()
            count = _finished()
            if count >= logs // 2:
                break
            done(count)
            most = max(most, _peak(running.pid))
            if not worker and count >= logs // 6:
                worker = _kill_a_worker(environment["AWS_ENDPOINT_URL"])
            time.sleep(max(_LOOK_SECONDS, (time.monotonic() - begin) / _LOOK_SHARE))
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(running.pid, signal.SIGKILL)
        running.wait()
        _await_workers(environment["AWS_ENDPOINT_URL"])
    return {"worker": worker, "command": most}


def _diagnosis(environment: Mapping[str, str]) -> dict[str, Any]:
    """Runs the command to its end."""
    running = subprocess.Popen(_command(), stdout=subprocess.PIPE, text=True, start_new_session=True)
    peaks = [0]
    watching = threading.Event()

    def watch() -> None:
        while not watching.wait(_LOOK_SECONDS):
            peaks.append(_peak(running.pid))

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    text, _ = running.communicate()
    watching.set()
    thread.join()
    if running.returncode != 0:
        raise SafedpaError(f"object-storage: the command ended with {running.returncode}")
    document: dict[str, Any] = json.loads(text)
    return {**document, "command_mebibytes": max(peaks)}


def _finished() -> int:
    return sum(name.endswith("/result.json") for name in find_files(_OUT))


def _current() -> tuple[int, int]:
    """Returns the number of results that count, and of those whose log the store did not deliver to its worker."""
    delivered = [bool(result["files"]) and result["status"] != "failed" for result in _results()]
    return sum(delivered), len(delivered) - sum(delivered)


def _results() -> list[dict[str, Any]]:
    names = [name for name in find_files(_OUT) if name.endswith("/result.json")]
    return [json.loads(content) for _, content in read_files(names) if content is not None]


def _status(result: Mapping[str, Any]) -> str:
    """Returns the status; ``too_short`` for a log that was read and is shorter than the horizon."""
    short = result["status"] == "unreadable" and not result["unreadable_files"]
    return "too_short" if short else str(result["status"])


def _mean_seconds(results: Sequence[Mapping[str, Any]], statuses: Sequence[str]) -> float:
    found = [result["processor_seconds"] for result in results if _status(result) in statuses]
    return float(np.mean(found)) if found else 0.0


def _workers(endpoint: str) -> list[int]:
    """Returns Ray's worker processes of this experiment: those with its store in their environment."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            is_worker = (folder / "cmdline").read_bytes().startswith(b"ray::")
            if is_worker and endpoint.encode() in (folder / "environ").read_bytes():
                found.append(int(folder.name))
    return found


def _kill_a_worker(endpoint: str) -> bool:
    for process in _workers(endpoint):
        with contextlib.suppress(ProcessLookupError):
            os.kill(process, signal.SIGKILL)
            return True
    return False


def _await_workers(endpoint: str, seconds: float = 60.0) -> None:
    """Waits until the workers of a killed command have ended, which is Ray's own doing."""
    until = time.monotonic() + seconds
    while _workers(endpoint) and time.monotonic() < until:
        time.sleep(_LOOK_SECONDS)


def _peak(process: int) -> int:
    """Returns the most memory of a process so far [MiB]; 0 once it has ended."""
    with contextlib.suppress(OSError):
        for line in Path(f"/proc/{process}/status").read_text(encoding="ascii").splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) // 1024
    return 0
