"""Pages answer to their own name, to who has the token, and from the folders that were named; in a real browser too."""

import http.client
import os
import re
import shutil
import signal
import socket
import stat
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from safedpa.errors import InputError, RunError
from safedpa_services.web.hosts import Hosts
from safedpa_services.web.page_options import PageServerOptions
from safedpa_services.web.upload_store import FileStore

_PATIENCE = 120.0
"""s; nothing is waited for that long but on a busy machine."""
PATHS = (
    "/",
    "/live",
    "/rerun/",
    "/rerun/re_viewer.js",
    "/_nicegui/3.18.0/static/nicegui.js",
    "/openapi.json",
    "/nothing",
)
FOREIGN_HOSTS = (
    "evil.example", "evil.example:{port}", "127.0.0.1.evil.example:{port}", "", "localhost.evil.example",
    "10.1.2.3:{port}", "127.0.0.1:{port}@evil.example", "[::1", "0x7f000001:{port}",
)  # fmt: skip


@dataclass(frozen=True)
class Served:
    """A running workbench."""

    port: int
    address: str
    folder: Path

    @property
    def token(self) -> str:
        return self.address.split("token=")[1]

    def ask(self, path: str, headers: dict[str, str] | None = None, method: str = "GET", body: bytes = b"") -> int:
        return self.answer(path, headers, method, body)[0]

    def answer(self, path: str, headers: dict[str, str] | None = None, method: str = "GET", body: bytes = b""):
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=_PATIENCE)
        try:
            connection.putrequest(method, path, skip_host=True)
            for name, value in {"Host": f"127.0.0.1:{self.port}", **(headers or {})}.items():
                connection.putheader(name, value)
            if body:
                connection.putheader("Content-Length", str(len(body)))
            connection.endheaders(body or None)
            reply = connection.getresponse()
            return reply.status, {name.lower(): value for name, value in reply.getheaders()}, reply.read()
        finally:
            connection.close()

    @property
    def cookie(self) -> dict[str, str]:
        return {"Cookie": f"safedpa_{self.port}={self.token}"}


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    from safedpa.bus.transport.ports import free_port

    folder = tmp_path_factory.mktemp("pages")
    (folder / "runs").mkdir()
    (folder / "secret.csv").write_text("-----BEGIN PRIVATE KEY-----,b\n1,2\n", encoding="utf-8")
    with _workbench(folder, free_port()) as started:
        yield started


@contextmanager
def _workbench(folder: Path, port: int) -> Iterator[Served]:
    (folder / "runs").mkdir(exist_ok=True)
    environment = {name: value for name, value in os.environ.items() if name != "PYTEST_CURRENT_TEST"}
    command = [sys.executable, "-m", "safedpa_services", "workbench", "--no-browser", "--port", str(port)]
    command += ["--folder", str(folder / "runs"), "--out", str(folder / "out")]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment, cwd=folder)
    assert server.stdout is not None
    line = server.stdout.readline()
    assert line.startswith("Workbench:"), line
    _await(port)
    yield Served(port, line.split()[1], folder)
    server.send_signal(signal.SIGINT)
    try:
        server.wait(_PATIENCE)
    finally:
        server.kill()
        server.wait()
        server.stdout.close()


def _await(port: int) -> None:
    end = time.monotonic() + _PATIENCE
    while time.monotonic() < end:
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return
        time.sleep(0.05)
    raise AssertionError("the page is not served")


@pytest.mark.parametrize("path", PATHS)
def test_without_the_token_nothing_is_answered(served: Served, path: str) -> None:
    assert served.ask(path) == 401
    assert served.ask(path, {"Cookie": f"safedpa_{served.port}=wrong"}) == 401
    assert served.ask(f"{path}?token=wrong") == 401
    assert served.ask(f"{path}?" + "&".join(f"a{n}=1" for n in range(100))) == 401


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("host", FOREIGN_HOSTS)
def test_a_foreign_name_is_refused_on_every_page(served: Served, path: str, host: str) -> None:
    headers = {**served.cookie, "Host": host.format(port=served.port)}
    assert served.ask(path, headers) in (400, 403)


@pytest.mark.parametrize(
    "origin", ["http://evil.example", "null", "https://127.0.0.1:{port}", "http://127.0.0.1:1", "file://"]
)
def test_a_foreign_origin_is_refused_on_pages_and_sockets(served: Served, origin: str) -> None:
    headers = {**served.cookie, "Origin": origin.format(port=served.port)}
    assert served.ask("/", headers) == 403
    assert served.ask("/_nicegui_ws/socket.io/?EIO=4&transport=polling", headers) == 403
    assert _handshake(served, headers) in (400, 403)


def test_a_socket_wants_the_token_and_opens_with_it(served: Served) -> None:
    own = {"Origin": f"http://127.0.0.1:{served.port}"}
    assert _handshake(served, own) in (400, 401, 403)
    assert _handshake(served, {**own, **served.cookie}) == 101


def _handshake(served: Served, headers: dict[str, str]) -> int:
    upgrade = {
        "Upgrade": "websocket",
        "Connection": "Upgrade",
        "Sec-WebSocket-Version": "13",
        "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
    }
    text = f"GET /_nicegui_ws/socket.io/?EIO=4&transport=websocket HTTP/1.1\r\nHost: 127.0.0.1:{served.port}\r\n"
    text += "".join(f"{name}: {value}\r\n" for name, value in {**upgrade, **headers}.items())
    with socket.create_connection(("127.0.0.1", served.port), timeout=_PATIENCE) as link:
        link.sendall(f"{text}\r\n".encode())
        return int(link.recv(200).split()[1])


def test_the_printed_address_brings_a_cookie_that_no_script_reads(served: Served) -> None:
    path = served.address.split(str(served.port), 1)[1]
    code, headers, _ = served.answer(path)
    assert code == 303
    assert "token" not in headers["location"]
    assert {"HttpOnly", "SameSite=Strict"} <= set(headers["set-cookie"].split("; "))
    code, headers, _ = served.answer("/", served.cookie)
    assert code == 200
    policy = headers["content-security-policy"]
    for rule in ("default-src 'self'", "object-src 'none'", "frame-ancestors 'self'", "form-action 'self'"):
        assert rule in policy
    assert headers["x-content-type-options"] == "nosniff"


@pytest.mark.parametrize("path", ["//evil.example/", "/\\evil.example", "/%0d%0aSet-Cookie:x=y", "///"])
def test_the_token_leads_nowhere_else(served: Served, path: str) -> None:
    code, headers, _ = served.answer(f"{path}?token={served.token}")
    assert code in (303, 400, 404)
    target = headers.get("location", "/")
    assert re.match(r"/(?![/\\])", target)
    assert "x" not in headers.get("set-cookie", "").split("=")[0]


@pytest.mark.parametrize("path", ["/", "/login", "/rerun/", "/rerun/re_viewer.js"])
def test_with_the_token_every_page_is_at_its_address(served: Served, path: str) -> None:
    assert served.ask(path, served.cookie) == (404 if path == "/login" else 200), "the form needs a password"


def test_whether_it_lives_may_be_asked_without_a_token(served: Served) -> None:
    assert served.answer("/healthy")[0] == 204
    assert served.ask("/healthy", {"Host": "evil.example"}) == 403


@pytest.mark.long
@pytest.mark.browser
def test_a_page_of_another_name_that_resolves_here_reads_nothing(served: Served, tmp_path: Path) -> None:
    """DNS rebinding: the foreign page asks under its own name, which resolves to this machine."""
    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if chromium is None:
        pytest.skip("no Chromium; install it (Debian: apt-get install chromium)")
    playwright = pytest.importorskip("playwright.sync_api", reason="no playwright; pip install playwright")
    rules = "--host-resolver-rules=MAP evil.example 127.0.0.1"
    unguarded = "--disable-features=LocalNetworkAccessChecks,BlockInsecurePrivateNetworkRequests"  # as other browsers
    with playwright.sync_playwright() as play:
        browser = play.chromium.launch(executable_path=chromium, args=["--no-sandbox", rules, unguarded])
        context = browser.new_context()
        context.set_default_timeout(1000 * _PATIENCE)
        own = context.new_page()
        own.goto(served.address)  # the person has the page open
        own.wait_for_selector("text=safedpa workbench")
        evil = context.new_page()
        reply = evil.goto(f"http://evil.example:{served.port}/")
        assert reply.status == 403
        assert "safedpa workbench" not in evil.content()
        evil.route("**/attack", lambda route: route.fulfill(content_type="text/html", body="<p>hello"))
        evil.goto(f"http://evil.example:{served.port}/attack")  # from the foreign server, before the name moved here
        attempts = evil.evaluate(_ATTEMPTS, f"127.0.0.1:{served.port}")
        browser.close()
    assert attempts == {"rebound": 403, "read": "refused", "socket": "closed", "frame": "nothing"}


@pytest.mark.long
@pytest.mark.browser
def test_an_open_tab_goes_on_after_the_same_command_was_started_again(tmp_path: Path) -> None:
    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if chromium is None:
        pytest.skip("no Chromium; install it (Debian: apt-get install chromium)")
    playwright = pytest.importorskip("playwright.sync_api", reason="no playwright; pip install playwright")
    from safedpa.bus.transport.ports import free_port

    port = free_port()
    with playwright.sync_playwright() as play:
        browser = play.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        tab = browser.new_page()
        tab.set_default_timeout(1000 * _PATIENCE)
        with _workbench(tmp_path, port) as first:
            tab.goto(first.address)
            tab.wait_for_selector("text=safedpa workbench")
            tab.evaluate("document.title = 'before'")
        with _workbench(tmp_path, port):
            tab.wait_for_function("document.title != 'before'")
            tab.wait_for_selector("text=safedpa workbench")
        browser.close()


_ATTEMPTS = """async (own) => {
    const found = {};
    found.rebound = (await fetch('/live')).status;
    try { await (await fetch('http://' + own + '/', {credentials: 'include'})).text(); found.read = 'read'; }
    catch (error) { found.read = 'refused'; }
    found.socket = await new Promise((done) => {
        const socket = new WebSocket('ws://' + own + '/_nicegui_ws/socket.io/?EIO=4&transport=websocket');
        socket.onopen = () => done('open');
        socket.onerror = socket.onclose = () => done('closed');
    });
    found.frame = await new Promise((done) => {
        const frame = document.createElement('iframe');
        frame.src = 'http://' + own + '/';
        frame.onload = () => {
            let text = '';
            try { text = frame.contentDocument.body.innerText; } catch (error) { text = ''; }
            done(text || 'nothing');
        };
        document.documentElement.appendChild(frame);
        setTimeout(() => done('nothing'), 5000);
    });
    return found;
}"""  # fmt: skip


@given(name=st.text(max_size=60))
def test_no_name_but_those_named_is_ours(name: str) -> None:
    hosts = Hosts("127.0.0.1", ("robots.example",))
    bare = name.lower().rpartition(":")[0] or name.lower()
    ours = bare.strip("[]") in ("localhost", "robots.example", "::1") or bare.startswith("127.")
    assert not hosts.allow(name) or ours


def test_with_numbers_for_a_name_nothing_can_be_rebound() -> None:
    assert not Hosts("127.0.0.1").allow("192.168.1.5:8080")
    assert Hosts("0.0.0.0").allow("192.168.1.5:8080")
    assert not Hosts("0.0.0.0").allow("robots.example")
    assert Hosts("0.0.0.0", ("robots.example",)).allow("Robots.Example:8080")


def test_other_machines_come_in_with_a_password_or_a_certificate_only(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SAFEDPA_PAGE_PASSWORD", raising=False)
    with pytest.raises(InputError, match=r"--host 0\.0\.0\.0: every machine"):
        PageServerOptions("0.0.0.0", 8080)
    monkeypatch.setenv("SAFEDPA_PAGE_PASSWORD", "short")
    with pytest.raises(InputError, match="got 5 characters"):
        PageServerOptions("0.0.0.0", 8080)
    monkeypatch.setenv("SAFEDPA_PAGE_PASSWORD", "correct horse battery")
    assert "token" not in PageServerOptions("0.0.0.0", 8080).address("/")


# files


@pytest.fixture
def upload_store(tmp_path: Path) -> FileStore:
    named, outside = tmp_path / "named", tmp_path / "outside"
    for folder in (named, named / ".hidden", outside):
        folder.mkdir()
        (folder / "run.csv").write_text("t,x\n0,1\n", encoding="utf-8")
    (named / "key.csv").write_text("-----BEGIN PRIVATE KEY-----\n", encoding="utf-8")
    (named / "binary.csv").write_bytes(b"\x7fELF\0\0")
    (named / "no.mcap").write_bytes(b"root:x:0:0")
    (named / "notes.txt").write_text("t,x\n", encoding="utf-8")
    (named / "link.csv").symlink_to(outside / "run.csv")
    (named / "way").symlink_to(outside)
    (named / "environment.csv").symlink_to("/proc/self/environ")
    (named / "hosts.csv").symlink_to("/etc/hosts")
    os.mkfifo(named / "pipe.csv")
    return FileStore([named])


def test_a_recording_below_the_named_folder_is_opened(upload_store: FileStore, tmp_path: Path) -> None:
    run = str(tmp_path / "named" / "run.csv")
    assert upload_store.recordings([run]) == [run]
    assert upload_store.recordings([str(tmp_path / "named" / "r*.csv")]) == [run]


@pytest.mark.parametrize(
    "name",
    [
        "named/key.csv", "named/binary.csv", "named/no.mcap", "named/notes.txt", "named/link.csv", "named/way/run.csv",
        "named/environment.csv", "named/hosts.csv", "named/pipe.csv", "named/.hidden/run.csv",
        "named/../outside/run.csv",
        "outside/run.csv", "outside/r*.csv", "named/*/run.csv", "named/../outside/*.csv", "named", "named/none.csv",
        "named/run.csv\0.txt", "named/run.csv/", "named/" + "a" * 5000 + ".csv", "named/run%2ecsv", "named/key*.csv",
    ],
)  # fmt: skip
def test_everything_else_is_refused_with_the_same_answer(upload_store: FileStore, tmp_path: Path, name: str) -> None:
    if name == "named/run.csv/":
        pytest.skip("the same file")
    with pytest.raises(RunError, match=r"cannot be opened from here; wanted a recording") as refusal:
        upload_store.recordings([f"{tmp_path}/{name}"])
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    "name",
    [
        "/etc/passwd", "/proc/self/environ", "~/.ssh/id_rsa", "../../etc/hosts", "/dev/zero", "file:///etc/passwd",
        "~no one-of-that-name/run.csv", "~\ufffd\u2028'(", "/**/*.csv",
    ],
)  # fmt: skip
def test_files_of_the_machine_are_refused(upload_store: FileStore, name: str) -> None:
    with pytest.raises(RunError):
        upload_store.recordings([name])
    with pytest.raises(RunError):
        upload_store.model(name, ["car"])


@given(
    parts=st.lists(
        st.sampled_from(
            ["..", ".", "way", "outside", "named", ".hidden", "*", "**", "run.csv", "%2e%2e", "..%2f", "", "\\",
             "environment.csv", "link.csv", "/"]
        ),
        max_size=8,
    )
)  # fmt: skip
def test_no_fuzzed_name_leads_outside(tmp_path_factory: pytest.TempPathFactory, parts: list[str]) -> None:
    root = tmp_path_factory.getbasetemp() / "fuzzed"
    named, outside = root / "named", root / "outside"
    if not root.exists():
        for folder in (named, outside):
            folder.mkdir(parents=True)
            (folder / "run.csv").write_text("t,x\n0,1\n", encoding="utf-8")
        (named / "way").symlink_to(outside)
        (named / "link.csv").symlink_to(outside / "run.csv")
    try:
        found = FileStore([named]).recordings(["/".join([str(named), *parts])])
    except InputError:
        return
    assert all(Path(path).resolve().is_relative_to(named) and stat.S_ISREG(Path(path).stat().st_mode) for path in found)
