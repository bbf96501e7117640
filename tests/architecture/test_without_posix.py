"""The library needs no POSIX: every module imports, and logs are read, where its modules and signals are missing."""

import subprocess
import sys
from pathlib import Path

import pytest

TAKEN_AWAY = """
import asyncio, concurrent.futures, importlib, multiprocessing, os, pkgutil, signal, socket, subprocess, sys, tempfile
import numpy, pyarrow.csv, pyarrow.parquet, scipy.linalg, scipy.optimize, scipy.signal
for name in {others!r}:
    try:
        importlib.import_module(name)
    except ImportError:
        pass
for name in ("fcntl", "resource", "termios", "pwd", "grp", "tty", "pty", "syslog"):
    sys.modules[name] = None
for name in ("O_NONBLOCK", "O_CLOEXEC", "O_DIRECTORY", "fork", "pidfd_open", "memfd_create", "getuid", "geteuid",
             "getpgid", "killpg", "setsid", "sched_getaffinity", "sysconf", "uname", "nice", "mkfifo", "getloadavg",
             "chown", "fchmod", "waitstatus_to_exitcode", "posix_fallocate"):
    if hasattr(os, name):
        delattr(os, name)
plain = ("SIGINT", "SIGTERM", "SIGABRT", "SIGFPE", "SIGILL", "SIGSEGV", "SIG_DFL", "SIG_IGN")
signals = [name for name in dir(signal) if name.startswith(("SIG", "ITIMER")) and name not in plain]
for name in [*signals, "setitimer", "getitimer", "alarm", "pause", "pthread_sigmask", "sigwait"]:
    delattr(signal, name)
for name in ("AF_UNIX", "send_fds", "recv_fds"):
    delattr(socket, name)
sys.platform = "win32"
"""
"""Standard library and other packages have their own ways on such a system, so they are imported before."""
HEAVY = (
    "click",
    "torch",
    "h5py",
    "plotly",
    "ray",
    "zenoh",
    "gymnasium",
    "rosbags",
    "pyulog",
    "fsspec",
    "rerun",
    "matplotlib",
)
IMPORTS = """
import safedpa
failed = []
for found in pkgutil.walk_packages(safedpa.__path__, "safedpa.", onerror=failed.append):
    if not found.name.endswith("__main__"):
        try:
            importlib.import_module(found.name)
        except Exception as error:
            failed.append(f"{found.name}: {error!r}")
print(failed)
"""
USES = """
import os, tempfile, safedpa, numpy as np
os.chdir(tempfile.mkdtemp())
t = 0.05 * np.arange(400)
columns = np.column_stack([t, t, 0.0 * t, 0.0 * t, 1.0 + 0.0 * t, 1.0 + 0.0 * t, 0.0 * t])
np.savetxt("drive.csv", columns, delimiter=",", header="t,x,y,yaw,speed,target_speed,steer", comments="")
run = safedpa.read_log("drive.csv", "car")
result = safedpa.compare("car", [run])
from safedpa.safety import FilterSettings, FunctionBarrier, SafetyFilter
settings = FilterSettings(action_low=(-1.0,), action_high=(1.0,), backup_action=(-1.0,), eta=0.1, epsilon=0.0)
affine = lambda x: (np.array([x[0] + 0.05 * x[1], x[1]]), np.array([[0.00125], [0.05]]))
verdict = SafetyFilter(affine, [FunctionBarrier(lambda x: 1.0 - x[0])], settings).decide(np.zeros(2), np.ones(1))
print(len(run.t), verdict.status.value)
"""
SERVICE = """
import safedpa_services.command_line.group as group
code = group.safedpa.run(["up"])
print(code)
import safedpa_services.service_main as service
service.service_parser("policy")
"""


def printed(code: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-W", "ignore", "-c", TAKEN_AWAY.format(others=HEAVY) + code]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)


@pytest.mark.long
def test_every_module_of_the_library_imports_without_posix() -> None:
    found = printed(IMPORTS)
    assert found.stdout == "[]\n", found.stdout + found.stderr[-2000:]


@pytest.mark.long
def test_a_log_is_read_compared_and_filtered_without_posix() -> None:
    found = printed(USES)
    assert found.stdout == "400 passed\n", found.stdout + found.stderr[-2000:]


@pytest.mark.long
def test_services_say_in_one_line_that_they_need_linux() -> None:
    found = printed(SERVICE)
    assert found.stdout.endswith("2\n")
    lines = found.stderr.splitlines()
    assert [line.split(";")[0] for line in lines] == ["safedpa: 'safedpa up' needs Linux", "policy needs Linux"]


CORE = (
    "safety/test_filter_verdicts.py", "safety/test_filter_conditions.py", "safety/test_filter_session.py",
    "safety/test_barriers.py", "records/test_tables.py", "records/test_segments.py",
)  # fmt: skip
"""Quick tests of the filter and of reading logs; those that use POSIX themselves are none of them."""
TESTS = """
import os, pytest

class OnlyTheTests:
    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self):
        sys.platform = "win32"
        try:
            return (yield)
        finally:
            sys.platform = "linux"

sys.platform, os.getuid = "linux", lambda: 0  # pytest's own start is that of this system
options = ["-q", "-p", "no:cacheprovider", "-p", "no:faulthandler", "-p", "no:xdist", "-m", "not long and not slow"]
sys.exit(pytest.main([*options, "--rootdir", {root!r}, *{files!r}], [OnlyTheTests()]))
"""


@pytest.mark.long
def test_the_core_tests_pass_without_posix() -> None:
    root = Path(__file__).resolve().parents[2]
    found = printed(TESTS.format(root=str(root), files=[str(root / "tests" / name) for name in CORE]))
    assert found.returncode == 0, found.stdout[-3000:] + found.stderr[-1000:]
    assert " passed" in found.stdout
