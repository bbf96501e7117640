"""Who connects and says nothing keeps nobody out, and no observer that cannot join ends a drive."""

from __future__ import annotations

import contextlib
import os
import resource
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from safedpa.bus import ZenohSettings, ZenohTransport
from safedpa.bus.access import roles_of
from safedpa.bus.authority import HOSTS, Authority
from safedpa.bus.certificates import Certificates
from safedpa.bus.doorkeeper import Doorkeeper, defer_accept
from safedpa_services.supervisor.supervisor import Supervisor

SILENT = 1000


@pytest.fixture
def certificates(tmp_path: Path) -> Path:
    authority = Authority(tmp_path / "certificates", "fleet")
    for role in roles_of(("r1",)):
        authority.issue(role, 1.0, HOSTS if role == "router" else ())
    return tmp_path / "certificates"


@contextlib.contextmanager
def router(port: int, *options: str) -> Iterator[int]:
    """With 1024 descriptors and no more; yields its process id."""
    command = [sys.executable, "-m", "safedpa_services.router", "--fleet", "fleet", "--robot", "r1", *options]
    line = f"ulimit -n 1024; exec {' '.join(command)}"
    process = subprocess.Popen(["bash", "-c", line], stderr=subprocess.DEVNULL)
    try:
        for _ in range(200):
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", port)) == 0:
                    break
            time.sleep(0.05)
        yield process.pid
    finally:
        process.kill()
        process.wait()


@contextlib.contextmanager
def strangers(port: int, count: int, says: bytes = b"") -> Iterator[None]:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard != resource.RLIM_INFINITY and hard < 2 * count:
        pytest.skip(f"no {2 * count} descriptors for the attack")
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, 2 * count), hard))
    with contextlib.ExitStack() as stack:
        for _ in range(count):
            link = stack.enter_context(socket.create_connection(("127.0.0.1", port), timeout=5.0))
            if says:
                link.send(says)
        yield


def join(port: int, certificates: Path | None) -> float:
    """s that it took."""
    began = time.monotonic()
    if certificates is None:
        settings = ZenohSettings("client", (), (f"tcp/127.0.0.1:{port}",))
    else:
        settings = ZenohSettings("client", (), (f"tls/127.0.0.1:{port}",), Certificates(certificates, "operator"))
    ZenohTransport(settings).close()
    return time.monotonic() - began


@pytest.mark.processes
@pytest.mark.slow
def test_a_thousand_silent_connections_keep_nobody_out(free_port: int, certificates: Path) -> None:
    options = ("--listen", f"tls/127.0.0.1:{free_port}", "--certificates", str(certificates))
    with router(free_port, *options) as pid, strangers(free_port, SILENT):
        for _ in range(3):
            assert join(free_port, certificates) < 1.0
            time.sleep(0.5)
        assert len(os.listdir(f"/proc/{pid}/fd")) < 200, "none of them holds a descriptor"


@pytest.mark.processes
@pytest.mark.slow
@pytest.mark.parametrize("says", [b"", b"\x16"], ids=["silent", "with a first byte"])
def test_in_plain_text_neither(free_port: int, says: bytes) -> None:
    options = ("--listen", f"tcp/127.0.0.1:{free_port}", "--plain")
    with router(free_port, *options), strangers(free_port, SILENT - 100, says):
        time.sleep(0.6)  # for those who say something, a moment to be cut off
        assert join(free_port, None) < 1.0


def test_strangers_are_cut_off_and_members_are_not(free_port: int) -> None:
    clock = [100.0]
    with socket.create_server(("127.0.0.1", free_port)) as listening:
        assert free_port in defer_accept()
        member, stranger = (socket.create_connection(("127.0.0.1", free_port)) for _ in range(2))
        for link in (member, stranger):
            link.send(b"x")
        accepted = [listening.accept()[0] for _ in range(2)]
        keeper = Doorkeeper({free_port}, lambda: [member.getsockname()], lambda: clock[0])
        try:
            time.sleep(0.3)
            clock[0] += 10.0
            stranger.settimeout(5.0)
            assert stranger.recv(1) == b""
            member.settimeout(0.3)
            with pytest.raises(TimeoutError):
                member.recv(1)
        finally:
            keeper.close()
            for link in (member, stranger, *accepted):
                link.close()


# the supervisor


@dataclass
class Scripted:
    """A process that ends with the given codes, one after the other, and then runs."""

    name: str
    codes: list[int] = field(default_factory=list)
    essential: bool = True
    pid: int = 0
    restarts: int = 0

    @property
    def exit_code(self) -> int | None:
        return self.codes[0] if self.codes and self.pid else None

    def start(self) -> None:
        self.pid += 1

    def restart_if_due(self) -> bool:
        self.codes.pop(0)
        self.restarts += 1
        return True

    def last_words(self) -> str:
        return "it cannot be used"

    def terminate(self) -> None:
        return

    def end(self, patience: float) -> None:
        return

    def kill(self) -> None:
        return


class Hearing:
    """A watch to which everybody speaks."""

    def __init__(self, names: list[str]) -> None:
        self.health = dict.fromkeys(names, None)

    def listen(self, wait: float) -> None:
        return

    def has_hung(self, *arguments: object) -> bool:
        return False

    def stop_robot(self) -> bool:
        return False


@pytest.mark.parametrize("code", [75, 2, 70])
def test_an_observer_that_cannot_join_does_not_end_the_drive(code: int) -> None:
    recorder: Any = Scripted("recorder", [])
    robot: Any = Scripted("robot")
    turns = [0]

    def turn() -> None:
        turns[0] += 1
        if turns[0] == 3:
            recorder.codes = [code] * 5
        if turns[0] == 40:
            robot.codes = [0]

    hearing: Any = Hearing(["recorder"])
    assert Supervisor([recorder], robot, hearing, lambda: turns[0] > 60, turn).run() == 0
    assert recorder.restarts == 5
    assert turns[0] == 40
