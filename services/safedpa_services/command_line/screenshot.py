"""``safedpa screenshot``: a picture of a dashboard recording, without a screen."""

from __future__ import annotations

import re
from pathlib import Path

import click

from safedpa.errors import InputError, SafedpaError

_TIMEOUT_SECONDS = 120.0


@click.command()
@click.argument("recording", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), required=True, help="PNG file")
@click.option("--size", default="1400x800", show_default=True, help="WIDTHxHEIGHT in points; two pixels a point")
def command(recording: Path, out: Path, size: str) -> None:
    """Make a picture of a dashboard RECORDING (.rrd) at its end."""
    if not recording.is_file():
        raise InputError(f"{recording}: no such file; wanted a recording that the dashboard wrote (--save FILE.rrd)")
    if not re.fullmatch(r"[1-9]\d{2,3}x[1-9]\d{2,3}", size):
        raise InputError(f"--size {size}: wanted WIDTHxHEIGHT of three or four digits each, such as 1400x800")
    if not out.parent.is_dir():
        raise InputError(f"--out {out}: folder {out.parent} does not exist; create it")
    _render(recording, out, size)
    click.echo(str(out))


def _render(recording: Path, out: Path, size: str) -> None:
    import os
    import subprocess

    arguments = [_viewer(), str(recording), "--headless", "--port", "auto", "--bind", "127.0.0.1"]
    arguments += ["--screenshot-to", str(out), "--window-size", size]
    out.unlink(missing_ok=True)
    try:
        done = subprocess.run(
            arguments,
            env={**os.environ, "RUST_LOG": "error"},  # else notices cover a part of the picture
            capture_output=True,
            text=True,
            timeout=_TIMEOUT_SECONDS,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise SafedpaError(f"{recording}: the viewer made no picture in {_TIMEOUT_SECONDS:.0f} s") from error
    if done.returncode != 0 or not out.is_file():
        raise SafedpaError(_reason(recording, done.stderr))


def _viewer() -> str:
    import importlib.util

    found = importlib.util.find_spec("rerun_cli")
    binary = Path(found.origin).parent / "rerun" if found and found.origin else None
    if binary is None or not binary.is_file():
        raise SafedpaError("screenshot: Rerun's viewer is not installed; install rerun-sdk")
    return str(binary)


def _reason(recording: Path, complaint: str) -> str:
    if "render context" in complaint or "graphics adapter" in complaint:
        return "screenshot: no graphics driver; install a software one (Debian: apt-get install mesa-vulkan-drivers)"
    last = next((line for line in reversed(complaint.splitlines()) if line.strip()), "no word from the viewer")
    return f"{recording}: no picture could be made ({last.strip()[:200]})"
