"""A whole drive of ``safedpa up --secure`` with few descriptors, while a thousand strangers connect and say nothing.

In the same run the same drive in peace, for comparison.
"""

from __future__ import annotations

import contextlib
import json
import os
import resource
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from safedpa.bus import ZenohSettings, ZenohTransport
from safedpa.bus.security.certificates import Certificates
from safedpa.errors import BusError, SafedpaError
from safedpa_lab.benchmarks.usage import load_average
from safedpa_services.supervisor.certificate_store import OPERATOR

SILENT = 1000
DESCRIPTORS = 1024
MOST_JOIN_SECONDS = 1.0
_PATIENCE_SECONDS = 60.0
_OWN_DESCRIPTORS = 256
"""Of this process, next to those of the attack."""


def silent_benchmark(
    seconds: float = 20.0, silent: int = SILENT, report_progress: Callable[[int, int], None] = lambda _done, _all: None
) -> dict[str, Any]:
    """The drive in peace and under attack. Raises SafedpaError where it does not begin, or sockets are too few."""
    load = load_average()
    drives = []
    for number, count in enumerate((0, silent)):
        report_progress(number, 2)
        drives.append(_drive(seconds, count))
    peace, attack = drives
    held = attack["exit_code"] == 0 and attack["ticks"] >= 0.99 * peace["ticks"] and attack["restarts"] == 0
    return {
        "seconds": seconds,
        "silent": silent,
        "descriptors": DESCRIPTORS,
        "in_peace": peace,
        "under_attack": attack,
        "held": held and attack["slowest_join_seconds"] < MOST_JOIN_SECONDS,
        "load_average": [load, load_average()],
    }


def _drive(seconds: float, silent: int) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        command = [sys.executable, "-m", "safedpa_services", "up", "--secure", "--headless", "--no-diagnosis", "--json"]
        command += ["--seconds", repr(seconds), "--seed", "4", "--out", str(folder / "runs")]
        (folder / "keys").mkdir(mode=0o700)
        environment = {**os.environ, "TMPDIR": str(folder / "keys")}
        with (folder / "notice").open("wb") as notice:
            limited = f'ulimit -n {DESCRIPTORS}; exec "$@"'
            running = subprocess.Popen(
                ["bash", "-c", limited, "bash", *command], stdout=notice, stderr=notice, env=environment
            )
        try:
            joins = _attack(folder, running, silent, seconds)
            code = running.wait(seconds + _PATIENCE_SECONDS)
        except subprocess.TimeoutExpired:
            code = -signal.SIGKILL
        finally:
            running.kill()
            running.wait()
        text = (folder / "notice").read_text(errors="replace")
    summary = json.loads(text[text.index("{") :]) if code == 0 else {}
    return {
        "exit_code": code,
        "notice": "" if code == 0 else text[-500:],
        "ticks": summary.get("ticks", 0),
        "watchdog_ticks": summary.get("watchdog_ticks", 0),
        "collisions": summary.get("collisions", 0),
        "restarts": sum(service["restarts"] for service in summary.get("services", ())),
        "joins": len(joins),
        "slowest_join_seconds": round(max(joins), 3) if joins else None,
    }


def _attack(folder: Path, running: subprocess.Popen[bytes], silent: int, seconds: float) -> list[float]:
    """Joins as a person once a second until shortly before the drive's end; how long each took, s."""
    endpoint = _endpoint(folder, running)
    keys = next((folder / "keys").glob("*/operator.pem")).parent
    joins: list[float] = []
    with _silent(endpoint, silent):
        end = time.monotonic() + 0.8 * seconds
        while time.monotonic() < end and running.poll() is None:
            joins.append(_join(endpoint, keys))
            time.sleep(1.0)
    return joins


def _endpoint(folder: Path, running: subprocess.Popen[bytes]) -> str:
    """Where the router listens, as it says."""
    until = time.monotonic() + _PATIENCE_SECONDS
    while time.monotonic() < until and running.poll() is None:
        for path in folder.glob("runs/*/router.log"):
            for line in path.read_text(errors="replace").splitlines():
                if '"router.open"' in line:
                    return str(json.loads(line)["sentence"].split(" on ")[1])
        time.sleep(0.05)
    raise SafedpaError(f"the drive did not begin: {(folder / 'notice').read_text(errors='replace')[-300:]}")


@contextlib.contextmanager
def _silent(endpoint: str, count: int) -> Iterator[None]:
    """So many connections that say nothing."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = count + _OWN_DESCRIPTORS
    if hard != resource.RLIM_INFINITY and hard < wanted:
        raise SafedpaError(f"the attack needs {wanted} descriptors, this process may have {hard}; raise 'ulimit -Hn'")
    resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
    host, _, port = endpoint.removeprefix("tls/").partition("#")[0].rpartition(":")
    with contextlib.ExitStack() as stack:
        for _ in range(count):
            stack.enter_context(socket.create_connection((host, int(port)), timeout=5.0))
        yield


def _join(endpoint: str, keys: Path) -> float:
    """s; infinite where it is not let in."""
    began = time.monotonic()
    settings = ZenohSettings("client", (), (endpoint.partition("#")[0],), Certificates(keys, OPERATOR))
    try:
        ZenohTransport(settings).close()
    except BusError:
        return float("inf")
    return time.monotonic() - began
