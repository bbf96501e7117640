"""The times of decisions status by status: problems follow from the seed, and every tree decides the same ones."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def told(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(ROOT / "deploy" / "filter_by_status.py"), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)


def test_a_tree_compared_with_itself_decides_alike_and_every_status_is_counted() -> None:
    tree = str(ROOT / "shared")
    found = told(f"before={tree}", f"after={tree}", "--scenes", "2", "--rounds", "1", "--seed", "7")
    assert found.returncode == 0, found.stderr
    lines = found.stdout.splitlines()
    assert [line.partition(" (")[0] for line in lines[:2]] == ["before", "after"]
    assert all("0 of 32 statuses differ, actions by 0.0e+00 at most" in line for line in lines[:2])
    counted = {line.split(",")[0]: int(line.split(",")[1].partition(":")[0]) for line in lines[2:]}
    assert sum(counted.values()) == 32
    assert {"passed", "corrected", "violated"} <= set(counted)
    looks = r"(\d+\.\d) actions looked at"
    found_of = {
        line.split(",")[0]: re.search(rf"before \d+ \(1\.00\), \d+ \(1\.00\), {looks}; after", line)
        for line in lines[2:]
    }
    actions = {status: float(match[1]) for status, match in found_of.items() if match}
    assert set(actions) == set(counted)
    assert actions["passed"] < actions["corrected"] < actions["violated"]


def test_a_tree_without_a_name_is_refused() -> None:
    found = told("somewhere")
    assert found.returncode == 2
    assert "got somewhere, wanted NAME=FOLDER" in found.stderr
