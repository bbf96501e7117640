"""Processes and a cluster: what goes wrong with one robot stays with that robot."""

import operator
import os
import signal
import subprocess
import sys
import time
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import pytest

from safedpa.fleet.workers import available_cores, in_processes, one_thread_each
from safedpa_services.command_line.group import safedpa


def failed(_job, reason):
    return f"failed: {reason}"


@pytest.mark.long
def test_a_job_that_raises_or_kills_its_process_costs_itself_alone():
    jobs = [partial(abs, -1), partial(int, "x"), partial(abs, -2), partial(os._exit, 3), partial(abs, -3)]
    answers = list(in_processes(operator.call, jobs, 1, failed))
    assert sorted(item for item in answers if isinstance(item, int)) == [1, 2, 3]
    reported = sorted(item for item in answers if isinstance(item, str))
    assert reported[0].startswith("failed: ValueError: invalid literal")
    assert "its process was killed" in reported[1]
    assert len(reported) == 2


def test_no_jobs_start_no_process():
    assert list(in_processes(operator.call, [], 2, failed)) == []
    assert available_cores() >= 1


def test_threads_are_put_back(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    with one_thread_each():
        assert os.environ["OMP_NUM_THREADS"] == os.environ["MKL_NUM_THREADS"] == "1"
    assert os.environ["OMP_NUM_THREADS"] == "7"
    assert "MKL_NUM_THREADS" not in os.environ


_DRIVER = """
import operator, os, time
from functools import partial
from safedpa.fleet.workers import in_processes
if __name__ == "__main__":
    jobs = [partial(os.getpid), partial(time.sleep, 600)]
    for answer in in_processes(operator.call, jobs, 1, lambda job, reason: reason):
        print(answer, flush=True)
"""


def alive(process: int) -> bool:
    try:
        status = Path(f"/proc/{process}/stat").read_text(encoding="utf-8")
    except OSError:
        return False
    return status.rsplit(")", 1)[1].split()[0] != "Z"


@pytest.mark.long
def test_a_killed_command_leaves_no_process_behind(tmp_path):
    script = tmp_path / "driver.py"
    script.write_text(_DRIVER, encoding="utf-8")
    quiet = subprocess.DEVNULL
    with subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, stderr=quiet, text=True) as driver:
        assert driver.stdout is not None
        worker = int(driver.stdout.readline())
        assert alive(worker)
        driver.kill()
    deadline = time.monotonic() + 120.0
    while alive(worker) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not alive(worker)


_ON_RAY = """
import operator
from functools import partial
from safedpa.fleet.workers import on_cluster
jobs = [partial(abs, -4), partial(int, "x"), partial(abs, -5)]
print(sorted(map(str, on_cluster(operator.call, jobs, "local", lambda job, reason: "failed " + reason, 1))))
"""


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.skipif(find_spec("ray") is None, reason="no Ray; pip install 'safedpa[cluster]'")
def test_a_local_cluster_answers_the_same():
    command = [sys.executable, "-c", _ON_RAY]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True)
    try:
        reported, _ = process.communicate(timeout=600)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
    assert process.returncode == 0
    last = reported.strip().splitlines()[-1]
    assert last == """['4', '5', "failed ValueError: invalid literal for int() with base 10: 'x'"]"""


def test_without_ray_it_says_what_to_install(monkeypatch, tmp_path, capsys):
    monkeypatch.setitem(sys.modules, "ray", None)
    recording = tmp_path / "fleet" / "r1" / "run.csv"
    recording.parent.mkdir(parents=True)
    recording.write_text("t\n0\n", encoding="utf-8")  # it is never read
    arguments = ["car", "--fleet", str(tmp_path / "fleet"), "--out", str(tmp_path / "out"), "--ray"]
    assert safedpa.run(["diagnose", *arguments]) == 2
    assert "pip install 'safedpa[cluster]'" in capsys.readouterr().err
