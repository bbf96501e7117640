"""Silent connections keep no member out."""

import contextlib
import os
import resource
import socket
import subprocess
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from tests.waiting import until

from safedpa.bus import ZenohSettings, ZenohTransport
from safedpa.bus.security.access_control import roles_of
from safedpa.bus.security.certificate_authority import HOSTS, Authority
from safedpa.bus.security.certificates import Certificates
from safedpa.bus.security.connection_reaper import ConnectionReaper, listening_ports
from safedpa.bus.transport import ports

SILENT = 1000
MORE_THAN_FIT = 1200
"""Into the descriptors of the router: fewer, in plain text, delay no member even without a doorkeeper."""


@pytest.fixture
def certificates(tmp_path: Path) -> Path:
    authority = Authority(tmp_path / "certificates", "fleet")
    for role in roles_of(("r1",)):
        authority.issue(role, 1.0, HOSTS if role == "router" else ())
    return tmp_path / "certificates"


def answers(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


@contextlib.contextmanager
def router(port: int, *options: str) -> Iterator[int]:
    """With 1024 descriptors and no more; yields its process id."""
    command = [sys.executable, "-m", "safedpa_services.router", "--fleet", "fleet", "--robot", "r1", *options]
    line = f"ulimit -n 1024; exec {' '.join(command)}"
    process = subprocess.Popen(["bash", "-c", line], stderr=subprocess.DEVNULL)
    try:
        assert until(lambda: answers(port)), "the router does not open its door"
        yield process.pid
    finally:
        process.kill()
        process.wait()


@contextlib.contextmanager
def strangers(port: int, count: int, reports: bytes = b"") -> Iterator[None]:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard != resource.RLIM_INFINITY and hard < 2 * count:
        pytest.skip(f"no {2 * count} descriptors for the attack")
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, 2 * count), hard))
    with contextlib.ExitStack() as stack:
        for _ in range(count):
            link = stack.enter_context(socket.create_connection(("127.0.0.1", port), timeout=5.0))
            if reports:
                link.send(reports)
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


def joins(port: int, quiet: int, certificates: Path | None, pause: float) -> Iterator[tuple[float, float]]:
    """s that three joins took, each with the slower of two at a quiet router, the one before and the one after it:
    what holds up this machine holds up those too, who is silent at ``port`` does not."""
    before = join(quiet, certificates)
    for _ in range(3):
        took, after = join(port, certificates), join(quiet, certificates)
        yield took, max(before, after)
        before = after
        time.sleep(pause)


@pytest.mark.long
@pytest.mark.processes
@pytest.mark.slow
def test_a_thousand_silent_connections_keep_no_member_out(free_port: int, certificates: Path) -> None:
    quiet = ports.free_port()
    doors = [("--listen", f"tls/127.0.0.1:{port}", "--certificates", str(certificates)) for port in (free_port, quiet)]
    with router(free_port, *doors[0]) as pid, router(quiet, *doors[1]), strangers(free_port, SILENT):
        for took, reference in joins(free_port, quiet, certificates, 0.5):
            assert took < 0.8 + 5.0 * reference
        assert len(os.listdir(f"/proc/{pid}/fd")) < 200, "none of them holds a descriptor"


@pytest.mark.long
@pytest.mark.processes
@pytest.mark.slow
@pytest.mark.parametrize("reports", [b"", b"\x16"], ids=["silent", "with a first byte"])
def test_nor_do_they_in_plain_text(free_port: int, reports: bytes) -> None:
    quiet = ports.free_port()
    doors = [("--listen", f"tcp/127.0.0.1:{port}", "--plain") for port in (free_port, quiet)]
    with router(free_port, *doors[0]), router(quiet, *doors[1]), strangers(free_port, MORE_THAN_FIT, reports):
        time.sleep(0.6)  # for those who say something, a moment to be cut off
        for took, reference in joins(free_port, quiet, None, 0.0):
            assert took < 0.8 + 5.0 * reference


@pytest.mark.long
@pytest.mark.processes
def test_members_of_another_session_of_the_process_are_left_alone(free_port, monkeypatch, links_outlive):
    """Two sessions in one process each guard their own port."""
    cut, look = defaultdict[int, list[int]](list), ConnectionReaper.check

    def counted(keeper: ConnectionReaper) -> int:
        cut[id(keeper)].append(look(keeper))
        return cut[id(keeper)][-1]

    monkeypatch.setattr(ConnectionReaper, "check", counted)
    doors = [f"tcp/127.0.0.1:{port}" for port in (free_port, ports.free_port())]
    sessions = [ZenohTransport(ZenohSettings("router", (door,))) for door in doors]
    guests = [ZenohTransport(ZenohSettings("client", connect=(door,))) for door in doors]
    try:
        time.sleep(4.0)  # a stranger has three seconds
        assert [len(looks) > 10 for looks in cut.values()] == [True, True]
        assert sum(map(sum, cut.values())) == 0
    finally:
        for transport in (*guests, *sessions):
            transport.close()


def test_sockets_are_looked_for_by_several_threads_at_once() -> None:
    """Two sessions of a process that listen have a doorkeeper each."""
    with contextlib.ExitStack() as held, ThreadPoolExecutor(4) as pool:
        doors = {held.enter_context(socket.create_server(("127.0.0.1", 0))).getsockname()[1] for _ in range(50)}
        for found in pool.map(lambda _: listening_ports(), range(400)):
            assert doors <= found


def test_no_connection_reaper_watches_a_unix_socket(tmp_path: Path) -> None:
    """Whatever may open the folder may connect; looking for strangers ten times a second would find none."""
    listening = ZenohTransport(ZenohSettings(listen=(f"unixsock-stream/{tmp_path}/bus",)))
    try:
        assert not [thread for thread in threading.enumerate() if thread.name.startswith(ConnectionReaper.__name__)]
    finally:
        listening.close()
