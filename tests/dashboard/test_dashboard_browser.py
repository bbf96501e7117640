"""The web viewer in a real browser, and pictures by the command line."""

import io
import os
import shutil
import subprocess
import sys
import time

import pytest

from safedpa_services.command_line.group import safedpa

pytestmark = pytest.mark.slow

_FLAGS = (
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--disable-background-networking",
)
_PATIENCE_SECONDS = 240
"""For a browser that draws without a graphics card, on a busy machine."""


@pytest.fixture
def recording(look, drive, tmp_path):
    from safedpa.bus import ReceivedMessage
    from safedpa_services.dashboard.fleet_view import FleetView
    from safedpa_services.dashboard.rerun_recording import RerunRecording

    path = tmp_path / "drive.rrd"
    recording = RerunRecording(look, "fleet", save=path, bind="127.0.0.1", grpc_port=None)
    view = FleetView(look)
    for k, tick in enumerate(drive(400)):
        frames = view.take(
            [ReceivedMessage(topic, "r1", message, b"", "key", 0.05 * k) for topic, message in tick], 0.05 * k
        )
        if k == 0:
            recording.arrange(view.fields)
        recording.draw(frames)
    recording.close()
    return path


def _colours(png: bytes) -> int:
    from PIL import Image

    image = Image.open(io.BytesIO(png)).convert("RGB")
    found = image.getcolors(maxcolors=1 << 24)
    return len([count for count, _ in found if count >= 20])


@pytest.mark.long
@pytest.mark.browser
def test_the_web_viewer_shows_the_drive(free_port):
    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if chromium is None:
        pytest.skip("no Chromium; install it (Debian: apt-get install chromium)")
    playwright = pytest.importorskip("playwright.sync_api", reason="no playwright; pip install playwright")
    script = [sys.executable, "-c", _SERVER, str(free_port)]
    quiet = {**os.environ, "RUST_LOG": "error"}
    server = subprocess.Popen(script, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=quiet)
    try:
        address = server.stdout.readline().strip()
        assert address.startswith("http")
        with playwright.sync_playwright() as play:
            patience = 1000 * _PATIENCE_SECONDS
            browser = play.chromium.launch(executable_path=chromium, args=list(_FLAGS), timeout=patience)
            page = browser.new_page(viewport={"width": 1400, "height": 800}, color_scheme="dark")
            page.goto(address, timeout=patience)
            shown, until = 0, time.monotonic() + _PATIENCE_SECONDS
            while shown <= 60 and time.monotonic() < until:
                page.wait_for_timeout(1000)
                shown = _colours(page.screenshot(timeout=patience))
            browser.close()
    finally:
        server.kill()
        server.communicate()
    assert shown > 60, "the loading page has some ten colours, the dashboard hundreds"


_SERVER = """
import sys, time
import rerun as rr
from safedpa.bus import ReceivedMessage, STATE, StateMessage
from safedpa.dynamics import load_model
from safedpa.safety import FilterSettings
from safedpa_services.dashboard.pages import DataProxy, private_loopback
from safedpa_services.dashboard.fleet_view import FleetView
from safedpa_services.dashboard.display_settings import display_settings
from safedpa_services.dashboard.rerun_recording import RerunRecording
from safedpa_services.dashboard.pages import ViewerServer
from safedpa_services.web.ports import choose_port

look = display_settings(load_model("car"), FilterSettings.for_robot("car"))
grpc = choose_port(None, int(sys.argv[1]) + 1, "--grpc-port", "127.0.0.1")
behind = (private_loopback(), grpc)
recording = RerunRecording(look, "fleet", save=None, bind=behind[0], grpc_port=grpc)
DataProxy("127.0.0.1", grpc, behind)
web = choose_port(None, grpc + 1, "--web-port", "127.0.0.1")
ViewerServer("127.0.0.1", web, grpc)
print(f"http://127.0.0.1:{web}", flush=True)
view = FleetView(look)
for k in range(2000):
    state = StateMessage(epoch=1, tick=k, robot_time=0.05 * k, publish_time=0.0, values=(0.002 * k - 2, 0.5, 0.3, 1.0),
        applied=(1.0, 0.2), applied_by="filter", period=0.05, lockstep=False, goal=(2.0, 2.0),
        obstacles=((1.0, 1.0, 0.3), (-1.0, -1.5, 0.25)), field=(-4.0, 4.0, -4.0, 4.0), footprint=(0.1, 0.4, 0.15))
    frames = view.take([ReceivedMessage(STATE, "r1", state, b"", "key", 0.05 * k)], 0.05 * k)
    if k == 0:
        recording.arrange(view.fields)
    recording.draw(frames)
    time.sleep(0.05)
sys.stdin.read()  # what was drawn is shown until its input ends
"""


@pytest.mark.long
def test_a_picture_of_a_recording_shows_something_everywhere(recording, tmp_path, capsys):
    out = tmp_path / "picture.png"
    code = safedpa.run(["screenshot", str(recording), "--out", str(out), "--size", "1000x600"])
    captured = capsys.readouterr()
    if "graphics driver" in captured.err:
        pytest.skip(captured.err)
    assert code == 0, captured.err
    assert captured.out.strip() == str(out)
    assert _colours(out.read_bytes()) > 60


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["missing.rrd", "--out", "a.png"], "missing.rrd: no such file"),
        ([__file__, "--out", "a.png"], "wanted one that the dashboard wrote"),
        (["a.rrd", "--out", "a.png", "--size", "big"], "--size big: wanted WIDTHxHEIGHT"),
        (["a.rrd", "--out", "/no/such/folder/a.png"], "folder /no/such/folder does not exist"),
        (["a.rrd", "--out", "a.rrd"], "got the recording itself"),
        (["a.rrd", "--out", "a.png", "--at", "nan"], "--at: got nan"),
    ],
)
def test_bad_input_of_screenshot_is_refused_in_one_line(arguments, complaint, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.rrd").write_bytes(b"RRF2 and no more")
    assert safedpa.run(["screenshot", *arguments]) == 2
    error = capsys.readouterr().err
    assert complaint in error
    assert error.count("\n") == 1
