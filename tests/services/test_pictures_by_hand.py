"""Why no picture could be made, in a sentence that says what to do: viewers and servers are made up."""

from __future__ import annotations

import io
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from safedpa.errors import SafedpaError
from safedpa_services.command_line.screenshot import _reason
from safedpa_services.workbench import pictures


@pytest.mark.parametrize(
    ("complaint", "driver_missing"),
    [
        ("Failed to create a render context: no adapter", True),
        ("noise\nno suitable graphics adapter found\nmore noise", True),
        ("the viewer shows nothing of it; is it a recording of the dashboard?", False),
        ("", False),
    ],
)
def test_a_missing_graphics_driver_is_named_and_else_what_was_said_last(complaint: str, driver_missing: bool) -> None:
    told = _reason(Path("drive.rrd"), complaint)
    assert ("apt-get install" in told) is driver_missing
    if not driver_missing:
        last = complaint.splitlines()[-1] if complaint else "no word"
        assert told.startswith("drive.rrd: no picture could be made")
        assert last in told


@pytest.mark.parametrize(("said", "address"), [("Workbench: http://127.0.0.1:8123/?token=x\n", True), ("", False)])
def test_a_page_is_photographed_where_its_server_says_that_it_is_and_ended_afterwards(
    said: str, address: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A server that ended before it said so has told why itself."""
    did: list[str] = []

    def started(command: list[str], **_: Any) -> Any:
        did.append(command[3])
        return SimpleNamespace(
            stdout=io.StringIO(said), terminate=lambda: did.append("terminate"), wait=lambda _: did.append("wait")
        )

    monkeypatch.setattr(pictures.subprocess, "Popen", started)
    if address:
        with pictures._served(["car", "run.csv"]) as found:
            assert found == "http://127.0.0.1:8123/?token=x"
    else:
        with pytest.raises(SafedpaError, match="could not be served"), pictures._served(["car", "run.csv"]):
            did.append("photographed")
    assert did == ["workbench", "terminate", "wait"]
