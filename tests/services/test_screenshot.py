"""Pictures without a screen: a failure is reported by a sentence that says what to do."""

import io
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest
from click.testing import CliRunner

from safedpa.errors import SafedpaError
from safedpa_services.command_line import screenshot
from safedpa_services.workbench import screenshots

LATER = 2.0
"""s that pass where the command sleeps."""


@pytest.fixture
def photographed(tmp_path, monkeypatch):
    """photographed(script): the error of the command with a viewer that runs this script, and how long it took."""
    pytest.importorskip("rerun")
    program = tmp_path / "rerun_cli" / "rerun"
    program.parent.mkdir()
    (program.parent / "__init__.py").touch()
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "rerun_cli", raising=False)
    later, clock = [0.0], time.monotonic

    def sleep(_):
        later[0] += LATER

    def run(script):
        program.write_text(f"#!/bin/sh\n{script}\n")
        program.chmod(0o755)
        recording = tmp_path / "drive.rrd"
        recording.write_bytes(b"RRF2")
        monkeypatch.setattr(time, "monotonic", lambda: clock() + later[0])
        monkeypatch.setattr(time, "sleep", sleep)
        result = CliRunner().invoke(screenshot.command, [str(recording), "--out", str(tmp_path / "page.png")])
        assert isinstance(result.exception, SafedpaError)
        return str(result.exception), later[0]

    return run


@pytest.mark.parametrize(
    ("script", "notice"),
    [
        ("echo noise; echo 'no suitable graphics adapter found'; echo more noise; exit 1", "apt-get install mesa"),
        ("echo 'Failed to create a render context: no adapter'; exit 1", "apt-get install mesa"),
        ("echo noise; exit 1", "drive.rrd: cannot be rendered ("),
    ],
)
def test_a_missing_graphics_driver_is_named_and_else_the_last_thing_that_was_reported(photographed, script, notice):
    error, _ = photographed(script)
    assert notice in error
    assert "noise" not in error
    assert "\n" not in error


def test_a_viewer_that_does_nothing_is_given_up_within_a_minute(photographed):
    error, took = photographed("exec sleep 600")
    assert "cannot be rendered" in error
    assert 10.0 <= took <= 60.0


@pytest.mark.parametrize("notice", ["", "Traceback\n"])
def test_a_page_that_is_not_served_cannot_be_photographed_and_its_server_is_ended(notice, tmp_path, monkeypatch):
    """The server has reported the reason itself."""
    pytest.importorskip("playwright")
    done: list[str] = []

    def started(command, **_):
        done.append(command[3])
        return SimpleNamespace(
            stdout=io.StringIO(notice), terminate=lambda: done.append("terminate"), wait=lambda _: done.append("wait")
        )

    monkeypatch.setattr(subprocess, "Popen", started)
    monkeypatch.setattr(screenshots, "find_browser", lambda: "chromium")
    with pytest.raises(SafedpaError, match="could not be served"):
        list(screenshots.take_screenshots(["car", "run.csv"], tmp_path / "pictures", live=False))
    assert done == ["workbench", "terminate", "wait"]
