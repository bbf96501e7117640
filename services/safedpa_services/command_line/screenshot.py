"""``safedpa screenshot``: renders a dashboard recording to a picture, without a screen."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import TYPE_CHECKING

import click

from safedpa.errors import InputError, SafedpaError
from safedpa.extras import needs
from safedpa_services.command_line.json_answer import answers_json, report_progress
from safedpa_services.command_line.options import PATH

if TYPE_CHECKING:
    import subprocess

_MAGIC = b"RRF"
"""First bytes of a Rerun file."""
_TIMEOUT_SECONDS = 20.0
_RENDER_SECONDS = 1.0
"""The plots are complete after a few frames; a software renderer draws about ten per second."""


@click.command()
@click.argument("recording", type=PATH)
@click.option("--out", type=PATH, required=True, help="PNG file")
@click.option("--size", default="1400x800", show_default=True, help="WIDTHxHEIGHT in pixels")
@click.option("--at", type=float, default=None, help="time on the time line in seconds; default: the end")
@answers_json
@needs("view")
def command(recording: Path, out: Path, size: str, at: float | None) -> None:
    """Render a dashboard RECORDING (.rrd) to a PNG picture."""
    if not recording.is_file():
        raise InputError(f"{recording}: no such file; wanted a recording that the dashboard wrote (--save FILE.rrd)")
    with recording.open("rb") as file:
        if file.read(len(_MAGIC)) != _MAGIC:
            raise InputError(
                f"{recording}: got no Rerun recording; wanted one that the dashboard wrote (--save FILE.rrd)"
            )
    if at is not None and not math.isfinite(at):
        raise InputError(f"--at: got {at}, wanted a time in seconds")
    if out.resolve() == recording.resolve():
        raise InputError(f"--out {out}: got the recording itself, which would be overwritten; choose another file")
    if not re.fullmatch(r"[1-9]\d{2,3}x[1-9]\d{2,3}", size):
        raise InputError(f"--size {size}: wanted WIDTHxHEIGHT of three or four digits each, such as 1400x800")
    if not out.parent.is_dir():
        raise InputError(f"--out {out}: folder {out.parent} does not exist; create it")
    _render(recording, out, size, at)
    report_progress(str(out), facts={"written": str(out)})


def _render(recording: Path, out: Path, size: str, at: float | None) -> None:
    import os
    import subprocess
    import tempfile

    from safedpa.bus.transport.ports import free_port
    from safedpa_services.web.viewer import viewer_program

    program, port = viewer_program(), free_port()
    if program is None:
        raise SafedpaError("screenshot: Rerun's viewer is not installed; install it with: pip install 'safedpa[view]'")
    command = [program, "--headless", "--bind", "127.0.0.1", "--port", str(port), "--window-size", size]
    quiet = {**os.environ, "RUST_LOG": "error"}  # otherwise notices cover a part of the picture
    with tempfile.TemporaryFile("w+") as log:
        viewer = subprocess.Popen(command, env=quiet, stdout=log, stderr=log)
        try:
            _save_screenshot(viewer, f"rerun+http://127.0.0.1:{port}/proxy", recording.resolve(), out.resolve(), at)
        except (RuntimeError, OSError, ValueError, TimeoutError) as error:
            log.seek(0)
            raise SafedpaError(_reason(recording, log.read() + f"\n{error}")) from error
        finally:
            viewer.kill()
            viewer.wait()


def _save_screenshot(viewer: subprocess.Popen[bytes], url: str, recording: Path, out: Path, at: float | None) -> None:
    import time

    from rerun.experimental import ViewerClient

    ends = time.monotonic() + _TIMEOUT_SECONDS
    client = None
    while client is None:
        try:
            client = ViewerClient.connect(url)
            client.get_state()
        except (RuntimeError, OSError, ValueError, TimeoutError):
            client = None
            if viewer.poll() is not None or time.monotonic() > ends:
                raise
            time.sleep(0.1)
    client.open(str(recording))
    while client.get_state().loading or not client.get_state().views:
        if viewer.poll() is not None or time.monotonic() > ends:
            raise TimeoutError("the viewer shows nothing; is it a recording of the dashboard?")
        time.sleep(0.1)
    if at is not None:
        client.set_time("t", duration=at, play_state="paused")
    time.sleep(_RENDER_SECONDS)
    client.save_screenshot(str(out))
    if not out.is_file():
        raise TimeoutError("the viewer wrote no file")


def _reason(recording: Path, complaint: str) -> str:
    if "render context" in complaint or "graphics adapter" in complaint:
        return "screenshot: no graphics driver; install a software one (Debian: apt-get install mesa-vulkan-drivers)"
    last = next((line for line in reversed(complaint.splitlines()) if line.strip()), "no message from the viewer")
    return f"{recording}: cannot be rendered ({last.strip()[:200]})"
