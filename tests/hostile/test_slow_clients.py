"""Slow, silent and many clients on every kind of port that speaks HTTP: they are cut off, and shut out no one."""

import asyncio
import contextlib
import http.client
import os
import socket
import ssl
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import uvicorn
from starlette.requests import Request
from starlette.responses import PlainTextResponse

from safedpa.bus import Bus, MemoryBroker, MemoryTransport
from safedpa.bus.monitor import FleetOverview
from safedpa.bus.transport.ports import free_port
from safedpa_services.dashboard.pages import DataProxy, ViewerServer
from safedpa_services.metrics.exporter import Exporter
from safedpa_services.web.guard import Guard
from safedpa_services.web.page_options import PageServerOptions, keep_token, kept_token
from safedpa_services.web.server import PageServer, server_options

PASSWORD, TOKEN = "correct horse battery", "a-token-of-the-tests-of-pages"


async def echo(scope, receive, send) -> None:
    """A page that reads whatever it is sent."""
    await PlainTextResponse(str(len(await Request(scope, receive).body())))(scope, receive, send)


@pytest.fixture(scope="module")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    from safedpa.bus.security.certificate_authority import Authority

    path = Authority(tmp_path_factory.mktemp("tls"), "yard").issue("router", 1.0, ("localhost",))
    return path, path.with_name("router.key.pem")


@pytest.fixture(scope="module")
def ports(certificate: tuple[Path, Path]) -> Iterator[dict[str, int]]:
    """By kind of server: its port."""
    numbers = {name: free_port() for name in ("data", "viewer", "page", "metrics")}
    options = PageServerOptions("127.0.0.1", numbers["page"], token=TOKEN, password=PASSWORD)
    servers = [
        DataProxy("127.0.0.1", numbers["data"], ("127.0.0.1", free_port())),
        ViewerServer("127.0.0.1", numbers["viewer"], numbers["data"]),
        PageServer(Guard(echo, options), "127.0.0.1", numbers["page"], "--port"),
    ]
    exporter = Exporter(FleetOverview(Bus(MemoryTransport(MemoryBroker()), "fleet")), "127.0.0.1", numbers["metrics"])
    numbers["TLS"] = free_port()
    served = uvicorn.Config(
        echo, port=numbers["TLS"], ssl_certfile=certificate[0], ssl_keyfile=certificate[1], lifespan="off",
        log_config=None, **server_options(),
    )  # fmt: skip
    secured = uvicorn.Server(served)
    thread = threading.Thread(target=secured.run, daemon=True)
    thread.start()
    while not secured.started:
        time.sleep(0.01)
    yield numbers
    for server in servers:
        server.close()
    exporter.run(lambda: True)  # ends at once
    secured.should_exit = secured.force_exit = True
    thread.join()


def client() -> ssl.SSLContext:
    context = ssl.create_default_context()
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    return context


def ask(port: int, method: str = "GET", path: str = "/", body: str = "", tls: bool = False) -> int:
    headers = {"Content-Type": "application/x-www-form-urlencoded"}
    kind = http.client.HTTPSConnection if tls else http.client.HTTPConnection
    link = kind("127.0.0.1", port, timeout=60.0, **({"context": client()} if tls else {}))
    with contextlib.closing(link):
        link.request(method, path, body, headers)
        return link.getresponse().status


def cookie(port: int) -> str:
    return f"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nCookie: safedpa_{port}={TOKEN}\r\n"


async def cut_off_after(port: int, first: str, tls: bool) -> float:
    """Seconds until the server closes a connection that sends ``first`` and then a byte twice a second."""
    began = time.monotonic()
    reader, writer = await asyncio.open_connection("127.0.0.1", port, ssl=client() if tls else None)
    writer.write(first.encode())
    with contextlib.suppress(OSError):
        while True:
            with contextlib.suppress(TimeoutError):
                if not await asyncio.wait_for(reader.read(65_536), 0.5):
                    break
            if first:
                writer.write(b"a")
    writer.close()
    return time.monotonic() - began


@pytest.mark.long
def test_silent_and_slow_clients_are_cut_off_on_every_port(ports: dict[str, int]) -> None:
    """Nothing, a head that never ends, a second such head, a body a byte at a time, no TLS handshake."""
    whole = "GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
    slow_body = cookie(ports["page"]).replace("GET", "POST") + "Content-Length: 9000\r\n\r\n"
    tries = {("page", slow_body), ("TLS", whole.replace("GET", "POST").replace("\r\n\r\n", "\r\nX: "))}
    tries |= {
        (name, first) for name in ports for first in ("", "GET / HTTP/1.1\r\nX: ", whole + "GET / HTTP/1.1\r\nX: ")
    }

    async def together() -> list[float]:
        found = [cut_off_after(ports[name], first, name == "TLS" and first != "") for name, first in tries]
        return await asyncio.wait_for(asyncio.gather(*found), 60.0)

    assert max(asyncio.run(together())) < 45.0


def test_many_silent_clients_do_not_shut_out_a_user_of_the_same_address(ports: dict[str, int]) -> None:
    """Also where they are more than the descriptors that are left, and where they wait for a TLS handshake."""
    for name, port in ports.items():
        links = [socket.create_connection(("127.0.0.1", port), timeout=60.0) for _ in range(300)]
        for link in links[200:] if name != "TLS" else ():  # some with a body that does not come
            with contextlib.suppress(OSError):
                link.sendall(f"{cookie(port).replace('GET', 'POST')}Content-Length: 9\r\n\r\n".encode())
        try:
            assert ask(port, tls=name == "TLS") in (200, 302, 303, 502), name
        finally:
            for link in links:
                link.close()


def test_wrong_passwords_do_not_delay_the_right_one_for_long(ports: dict[str, int]) -> None:
    """Forty at the same time, from the same address; the right one is taken once places are free, after a second."""
    codes: list[int] = []
    wrong = [
        threading.Thread(target=lambda: codes.append(ask(ports["page"], "POST", "/login", "password=wrong")))
        for _ in range(40)
    ]
    for thread in wrong:
        thread.start()
    for thread in wrong:
        thread.join()
    assert set(codes) == {401, 429}
    assert ask(ports["page"], "POST", "/login", "password=correct+horse+battery") == 303


def test_the_token_of_a_session_is_kept_for_its_user_alone(tmp_path: Path) -> None:
    folder, other = tmp_path / "out", tmp_path / "other"
    token = kept_token(folder)
    assert not folder.exists(), "a command that is refused writes nothing"
    keep_token(folder, token)
    keep_token(other, kept_token(other))
    path = folder / "page-token"
    assert path.stat().st_mode & 0o777 == 0o600
    assert kept_token(folder) == token != kept_token(other)
    os.chmod(path, 0o644)
    assert kept_token(folder) != token
    keep_token(folder, token)
    assert path.stat().st_mode & 0o777 == 0o600
    path.unlink()
    path.symlink_to(other / "page-token")
    assert kept_token(folder) not in (token, kept_token(other))
