"""Killing the diagnosis changes nothing for the car: the same drive, bit for bit."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [pytest.mark.long, pytest.mark.processes]

DRIVE = ["--model", "car_measured", "--seconds", "20", "--seed", "2"]
DRIVE += ["--change", "steering_offset", "--change-after", "8"]


def up(folder: Path, *options: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "safedpa_services", "up", "--headless", "--json", "--lockstep", *DRIVE]
    return subprocess.Popen([*command, "--out", str(folder), *options], stdout=subprocess.PIPE, text=True)


def children_of(parents: set[int]) -> dict[int, str]:
    """Process ids and command lines of the processes whose parent is one of these."""
    found = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                parent = int((entry / "stat").read_text(encoding="utf-8").rsplit(")", 1)[1].split()[1])
                line = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
            except OSError:
                continue
            if parent in parents:
                found[int(entry.name)] = line
    return found


def test_killing_the_diagnosis_changes_nothing_for_the_car(tmp_path: Path) -> None:
    """Its search is a process of its own that speaks to the diagnosis alone, and ends with it."""
    alone = up(tmp_path / "alone", "--no-diagnosis")
    without = json.loads(alone.communicate(timeout=600)[0])
    process = up(tmp_path / "watched", "--diagnosis")
    killed: set[int] = set()
    while process.poll() is None:
        services = children_of({process.pid})
        robot = any("safedpa_sim.robots" in line for line in services.values())
        watching = {pid for pid, line in services.items() if "safedpa_services.diagnosis" in line}
        for pid in watching - killed if robot and len(killed) < 2 else set():
            killed.add(pid)
            os.kill(pid, signal.SIGKILL)
        try:
            process.wait(0.05)
        except subprocess.TimeoutExpired:
            continue
    with_it = json.loads(process.communicate()[0])
    restarts = {entry["name"]: entry["restarts"] for entry in with_it["services"]}
    assert len(killed) >= 1
    assert restarts["diagnosis"] >= 1
    assert sum(restarts.values()) == restarts["diagnosis"]
    assert with_it["trajectory_sha256"] == without["trajectory_sha256"]
    assert with_it["collisions"] == without["collisions"] == 0
    assert with_it["watchdog_ticks"] == 0
