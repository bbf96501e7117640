"""Without options nothing listens for other machines, and no other user of this one gets to the bus."""

import errno
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

pytestmark = [pytest.mark.long, pytest.mark.processes, pytest.mark.slow]

LOOPBACK_6 = ("00000000000000000000000001000000", "0000000000000000FFFF00000100007F")
"""As the kernel writes ::1 and ::ffff:127.0.0.1."""
NO_ONE = 65534
"""The user of no rights."""


def is_loopback(address: str) -> bool:
    """Whether an address in the kernel's writing is of the loopback interface: for IPv4 all of 127.0.0.0/8.

    The viewer's data stand at one that is drawn, behind the door at 127.0.0.1 (RFC 1122, section 3.2.1.3).
    """
    return address in LOOPBACK_6 or (len(address) == 8 and address.endswith("7F"))


def descendants(pid: int) -> list[int]:
    found, waiting = [], [pid]
    while waiting:
        now = waiting.pop()
        found.append(now)
        for task in Path(f"/proc/{now}/task").glob("*/children"):
            try:
                waiting += [int(child) for child in task.read_text().split()]
            except OSError:
                continue
    return found


def listening(pids: list[int]) -> dict[str, str]:
    """Addresses in the kernel's writing on which these processes listen, with what each is: what ``ss -ltnp`` shows."""
    sockets = {}
    for pid in pids:
        try:
            for entry in Path(f"/proc/{pid}/fd").iterdir():
                target = os.readlink(entry)
                if target.startswith("socket:["):
                    phrase = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
                    sockets[target[8:-1]] = b" ".join(phrase[:4]).decode()
        except OSError:
            continue
    found = {}
    for name in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{name}").read_text().splitlines()[1:]:
            fields = line.split()
            if fields[3] == "0A" and fields[9] in sockets:
                found[fields[1]] = sockets[fields[9]]
    return found


@pytest.fixture(params=[(), ("--secure",)], ids=["plain", "secure"])
def running(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[subprocess.Popen[str], list[str]]]:
    """A whole loop with dashboard, diagnosis and workbench, and what it printed at its start."""
    if request.param and os.getuid() != 0:
        pytest.skip("processes with keys show what they listen on to root alone")
    command = [sys.executable, "-m", "safedpa_services", "up", "--out", str(tmp_path), *request.param]
    environment = {name: value for name, value in os.environ.items() if name != "PYTEST_CURRENT_TEST"}
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment) as process:
        assert process.stderr is not None
        hints = [process.stderr.readline() for _ in range(5)]
        yield process, hints
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=60)


def test_everything_that_listens_does_so_on_the_loopback_interface(running: tuple[subprocess.Popen[str], list[str]]):
    process, hints = running
    end = time.monotonic() + 90.0
    found: dict[str, str] = {}
    while time.monotonic() < end:
        found = listening(descendants(process.pid))
        programs = " ".join(found.values())
        if "dashboard" in programs and "workbench" in programs:
            break
        time.sleep(0.5)
    assert "dashboard" in " ".join(found.values()), (found, hints)
    assert [address for address in found if not is_loopback(address.split(":")[0])] == [], found
    if not any("certificates" in hint for hint in hints):
        _no_other_user_gets_in(hints)


def _no_other_user_gets_in(hints: list[str]) -> None:
    """The bus is a socket in a folder of this user's."""
    line = next(hint for hint in hints if "unixsock-stream/" in hint)
    path = line.split("unixsock-stream/")[1].split()[0]
    assert Path(path).parent.stat().st_mode & 0o077 == 0
    if os.getuid() != 0:
        return
    assert _knocks(path, os.getuid()) == 0
    assert _knocks(path, NO_ONE) == errno.EACCES


def _knocks(path: str, user: int) -> int:
    """What the kernel says to this user who connects there; 0: welcome."""
    child = os.fork()
    if child == 0:
        os.setuid(user)
        with socket.socket(socket.AF_UNIX) as link:
            os._exit(link.connect_ex(path))
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
