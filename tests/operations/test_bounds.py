"""What grows with a run has a limit: logs, memory of the recorder, the dashboard's file."""

import gc
import tracemalloc
from pathlib import Path

import pytest

from safedpa.bus.logging import log_event
from safedpa.records import McapRecorder
from safedpa_services.supervisor.child import MOST_LOG_BYTES, Child
from safedpa_services.supervisor.log_warnings import LogWarnings


def test_a_long_log_is_moved_once_and_what_the_process_writes_next_is_still_read(tmp_path: Path, capfd) -> None:
    child = Child("policy", "module", (), tmp_path / "policy.log")
    heard: list[str] = []
    watch = LogWarnings([child], tmp_path, heard.append)
    with child.log.open("ab") as log:  # as the process has it open
        for letter in (b"a", b"b"):
            log.write(letter * MOST_LOG_BYTES)
            log.flush()
            child.rotate_log()
            assert child.log.stat().st_size == 0
            assert child.log.with_name("policy.log.1").read_bytes()[:1] == letter
        log_event("kind", "a warning after the move", level="warning", service="policy")
        log.write(capfd.readouterr().err.encode())
        log.flush()
        watch.look()
    assert [line for line in heard if "a warning after the move" in line]
    assert len(list(tmp_path.glob("policy.log*"))) == 2


def test_on_a_full_disk_a_long_log_is_emptied(tmp_path: Path) -> None:
    child = Child("policy", "module", (), tmp_path / "policy.log")
    child.log.write_bytes(b"a" * MOST_LOG_BYTES)
    child.log.with_name("policy.log.1").mkdir()  # nothing can be written there
    child.rotate_log()
    assert child.log.stat().st_size == 0


@pytest.mark.long
def test_the_recorder_of_three_robots_keeps_less_than_five_megabytes_an_hour(tmp_path: Path) -> None:
    keys = [
        f"safedpa/yard/r{k}/{name}" for k in (1, 2, 3) for name in ("state", "action", "verdict", "nominal", "latent")
    ]
    used = []
    tracemalloc.start()
    with McapRecorder(tmp_path / "a.mcap") as recorder:
        for second in range(121):
            for tick in range(20):
                moment = 10**18 + second * 10**9 + tick * 5 * 10**7
                for key in keys:
                    recorder.write(key, b"x" * 300, moment, moment)
            if second in (60, 120):
                gc.collect()
                used.append(tracemalloc.get_traced_memory()[0])
    tracemalloc.stop()
    assert 60 * (used[1] - used[0]) < 5_000_000
