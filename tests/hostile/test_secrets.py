"""No output of a secured run holds a secret: keys, the token and the password of its page, in any common encoding."""

import base64
import http.cookiejar
import os
import re
import signal
import subprocess
import sys
import urllib.parse
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.waiting import until

from safedpa.bus.transport.ports import free_port
from safedpa.records.readers.mcap import read_payloads
from safedpa_services.web.viewer import viewer_program

PASSWORD = "correct-horse-battery-staple"
PRIVATE = ("page-address", "page-token")
"""Files that exist to hand the token to the user; all others are searched."""


def encodings(secret: str) -> Iterator[bytes]:
    """A secret as it is, and as other programs write it."""
    raw = secret.encode()
    yield from (raw, raw.hex().encode(), urllib.parse.quote(secret).encode(), base64.b64encode(raw).rstrip(b"="))
    yield secret.encode("utf-16-le")


def leaks(content: bytes, secrets: dict[str, str]) -> list[str]:
    """Returns the names of the secrets in ``content``."""
    found = [name for name, secret in secrets.items() if any(one in content for one in encodings(secret))]
    return [*found, *(["a private key"] if b"PRIVATE KEY" in content else [])]


class Run:
    """``up --secure`` in the background, and everything that it writes."""

    def __init__(self, folder: Path) -> None:
        self.outputs: dict[str, bytes] = {}
        self._place, private = folder / "runs", folder / "private"
        private.mkdir()
        environment = {**os.environ, "TMPDIR": str(private), "SAFEDPA_PAGE_PASSWORD": PASSWORD, "SAFEDPA_LOG": "json"}
        environment.pop("PYTEST_CURRENT_TEST", None)  # the page's framework would not serve
        self._printed, self._errors = folder / "stdout", folder / "stderr"
        command = [sys.executable, "-m", "safedpa_services", "up", "--secure"]
        with self._printed.open("wb") as printed, self._errors.open("wb") as errors:
            self.process = subprocess.Popen(
                [*command, "--out", str(self._place)], stdout=printed, stderr=errors, env=environment
            )
        assert until(lambda: "--connect" in self._text() and bool(list(self._place.glob("*/page-address"))))
        match = re.search(r"(--connect \S+ --fleet \S+ --certificates \S+)", self._text())
        assert match is not None
        self.join = match[1].split()
        (address,) = self._place.glob("*/page-address")
        self.address = urllib.parse.urlsplit(address.read_text().strip())
        (key,) = private.rglob("*.key.pem")
        self.secrets = {
            "password": PASSWORD,
            "token": urllib.parse.parse_qs(self.address.query)["token"][0],
            "key": "".join(key.read_text().splitlines()[1:-1])[20:60],
        }

    def _text(self) -> str:
        return (self._printed.read_bytes() + self._errors.read_bytes()).decode()

    def ask(self) -> None:
        """Collects what other commands, the page and the metrics show."""
        for name in ("status", "metrics"):
            port = str(free_port())
            module = (
                ("safedpa_services", "status")
                if name == "status"
                else ("safedpa_services.metrics", "--role", "operator", "--port", port)
            )
            with subprocess.Popen(
                [sys.executable, "-m", *module, *self.join], stdout=subprocess.PIPE, stderr=subprocess.STDOUT
            ) as asked:
                if name == "metrics":
                    assert until(lambda port=port: self._fetch("metrics", f"http://127.0.0.1:{port}/metrics"))
                    asked.terminate()
                assert asked.stdout is not None
                self.outputs[f"output of {name}"] = asked.stdout.read()
        page = f"http://{self.address.netloc}"
        assert until(lambda: self._fetch("page", f"{page}/healthy"))
        opener = urllib.request.build_opener(urllib.request.HTTPCookieProcessor(http.cookiejar.CookieJar()))
        form = urllib.parse.urlencode({"password": PASSWORD}).encode()
        for path, body in (("/", None), ("/login", form), ("/live", None), ("/healthy", None)):
            with opener.open(f"{page}{path}", body, timeout=60.0) as answer:
                self.outputs[f"page {path}"] = answer.read()

    def _fetch(self, name: str, address: str) -> bool:
        try:
            with urllib.request.urlopen(address, timeout=60.0) as answer:
                self.outputs[name] = answer.read()
        except OSError:
            return False
        return name != "metrics" or b"safedpa_" in self.outputs[name]

    def end(self) -> None:
        """Ends the run, and collects all its files with the contents of the recordings."""
        self.process.send_signal(signal.SIGINT)
        assert self.process.wait(180.0) == 0, self._text()
        self.outputs |= {"terminal": self._printed.read_bytes(), "errors": self._errors.read_bytes()}
        for path in (path for path in self._place.rglob("*") if path.is_file()):
            if path.name in PRIVATE:
                assert path.stat().st_mode & 0o077 == 0
            else:
                self.outputs[path.name] = path.read_bytes()
            if path.suffix == ".mcap":
                found = read_payloads(path)
                self.outputs["recorded messages"] = b"".join(key.encode() + payload for key, _, _, payload in found)
            if path.suffix == ".rrd" and (program := viewer_program()):
                printed = subprocess.run([program, "rrd", "print", "-vvv", str(path)], capture_output=True, check=False)
                self.outputs["drawn values"] = printed.stdout


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.processes
def test_no_output_of_a_secured_run_holds_a_secret(tmp_path: Path) -> None:
    run = Run(tmp_path)
    try:
        run.ask()
        run.end()
    finally:
        run.process.kill()
        run.process.wait()
    wanted = {"terminal", "errors", "metrics", "output of status", "page /live", "recorded messages", "workbench.log"}
    assert wanted | {"dashboard.rrd", "router.log", "drawn values"} <= set(run.outputs)
    assert len(run.outputs["recorded messages"]) > 10_000
    assert {name: found for name, content in run.outputs.items() if (found := leaks(content, run.secrets))} == {}


def test_the_search_finds_a_secret_in_each_encoding() -> None:
    for one in encodings(PASSWORD):
        assert leaks(b"before " + one + b" after", {"password": PASSWORD}) == ["password"]
