"""The process: one line with the address, taken ports, an end within two seconds."""

import signal
import socket
import subprocess
import sys
import time
import urllib.request

import pytest

from safedpa.errors import InputError
from safedpa_services.dashboard.pages import ViewerServer
from safedpa_services.web.ports import choose_port, open_server

pytestmark = pytest.mark.processes

PATIENCE = 240.0
"""s; a dashboard has a low priority, and a busy machine leaves it little time."""


def _start(*options):
    command = [sys.executable, "-m", "safedpa_services.dashboard", "--fleet", "alone", *options]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.mark.long
def test_it_prints_its_address_and_ends_at_once_without_a_viewer(tmp_path):
    began = time.monotonic()
    process = _start("--save", str(tmp_path / "a.rrd"))
    try:
        line = process.stdout.readline()
        beginning = time.monotonic() - began
        assert line.startswith("dashboard: http://localhost:"), process.stderr.read()
        address = line.split()[1].rstrip(",")
        with urllib.request.urlopen(address, timeout=PATIENCE) as page:
            assert page.status == 200
            assert "rerun%2Bhttp://localhost" in page.url
            text = page.read()
            assert b'memory_limit: "60MB"' in text, "the viewer keeps what it is sent within a limit"
            assert b"location.reload()" in text, "and what it has not drawn, too"
        started = time.monotonic()
        process.send_signal(signal.SIGTERM)
        rest, complaint = process.communicate(timeout=PATIENCE)
        assert time.monotonic() - started < 8.0 + 2.0 * beginning, "it waited for a viewer"
        assert process.returncode == 0
        assert (rest, complaint) == ("", "")
        assert (tmp_path / "a.rrd").stat().st_size > 0
    finally:
        process.kill()


@pytest.mark.long
@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (("--no-viewer",), "--no-viewer: got it without --save"),
        (("--save", "/no/such/folder/a.rrd"), "/no/such/folder/a.rrd"),
        (("--model", "no_such_model"), "no_such_model"),
    ],
)
def test_bad_options_are_refused_in_one_line(options, complaint):
    process = _start(*options)
    try:
        out, error = process.communicate(timeout=PATIENCE)
    finally:
        process.kill()
    assert process.returncode == 2
    assert complaint in error
    assert error.count("\n") == 1
    assert out == ""


def test_a_taken_port_is_refused_if_requested_and_skipped_otherwise(free_port):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", free_port))
        taken.listen()
        with pytest.raises(InputError, match=f"--web-port {free_port}: got a port that is taken"):
            choose_port(free_port, 9090, "--web-port", "127.0.0.1")
        assert choose_port(None, free_port, "--web-port", "127.0.0.1") > free_port


def test_a_port_that_was_taken_since_it_was_chosen_is_skipped_unless_requested(free_port):
    """Two dashboards that start at the same time find the same ports free."""
    doors = []

    def open_door(port):
        doors.append(ViewerServer("127.0.0.1", port, 5678))

    with socket.socket() as taken:
        taken.bind(("127.0.0.1", free_port))
        taken.listen()
        port = open_server(open_door, free_port, required=False)
        with pytest.raises(InputError, match=f"--web-port {free_port}"):
            open_server(open_door, free_port, required=True)
    (door,) = doors
    door.close()
    assert port > free_port


def test_the_page_redirects_a_browser_under_the_host_name_of_its_request(free_port):
    door = ViewerServer("127.0.0.1", free_port, 5678, ("robot.local",))
    request = urllib.request.Request(f"http://127.0.0.1:{free_port}", headers={"Host": f"robot.local:{free_port}"})

    class Stay(urllib.request.HTTPRedirectHandler):
        def redirect_request(self, *arguments):
            return None

    with pytest.raises(urllib.error.HTTPError) as answer:
        urllib.request.build_opener(Stay).open(request, timeout=PATIENCE)
    assert answer.value.headers["Location"] == "/?url=rerun%2Bhttp://robot.local:5678/proxy"
    answer.value.close()
    door.close()
