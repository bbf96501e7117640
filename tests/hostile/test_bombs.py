"""Small inputs that ask for much are refused within a second and 200 MB, with one line that says why."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from safedpa_lab.experiments.hostile.bombs import BOMBS, Bomb

SECONDS, MEGABYTES = 1.0, 200.0
_ATTEMPT = """
import json, sys, time
from pathlib import Path
import numpy, pyarrow.parquet, pyarrow.csv, zstandard, lz4.frame, mcap.reader, safetensors
import safedpa.dynamics, safedpa.records, safedpa.records.mcap_run, safedpa.safety.margin_text
from safedpa_lab.experiments.hostile.bombs import attempt
began = time.process_time()
try:
    refusal = attempt(Path(sys.argv[1]))
except Exception as error:
    refusal = f"HOLE {type(error).__name__}: {error}"[:300]
spent = time.process_time() - began
peak = next(line for line in open("/proc/self/status") if line.startswith("VmHWM"))  # of this program alone
print(json.dumps([refusal, spent, float(peak.split()[1]) / 1024.0]))
"""


@pytest.mark.parametrize("bomb", BOMBS, ids=lambda bomb: f"{bomb.ending[1:]}: {bomb.name}")
def test_a_bomb_is_refused_soon_and_in_little_memory(bomb: Bomb, tmp_path: Path) -> None:
    path = tmp_path / f"bomb{bomb.ending}"
    path.write_bytes(bomb.make())
    command = [sys.executable, "-c", _ATTEMPT, str(path)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=40, env=os.environ, check=False)
    finally:
        path.unlink()
    assert done.returncode == 0, done.stderr[-500:]
    refusal, seconds, megabytes = json.loads(done.stdout)
    assert refusal
    assert not refusal.startswith("HOLE")
    assert "\n" not in refusal
    assert len(refusal) < 1000
    assert seconds < SECONDS
    assert megabytes < MEGABYTES
