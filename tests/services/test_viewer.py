"""Timeouts for the files of Rerun's viewer; network, process and clock are simulated."""

import io
import subprocess
import urllib.error
import urllib.request
from types import SimpleNamespace

import pytest

from safedpa.errors import SafedpaError
from safedpa_services.web.viewer import Viewer


@pytest.fixture
def fetched(clock, monkeypatch):
    """fetched(seconds, since, code): the first file of a program that answers after ``seconds``, from ``since`` on."""

    def run(seconds, since=0.0, code=None):
        killed: list[int] = []

        def urlopen(_address, timeout):
            if clock.now < since:
                raise urllib.error.URLError("connection refused")
            clock.now += min(seconds, timeout)
            if seconds > timeout:
                raise urllib.error.URLError("timed out")
            return io.BytesIO(b"viewer")

        def started(*_, **__):
            return SimpleNamespace(poll=lambda: code, kill=lambda: killed.append(1), wait=lambda: None)

        monkeypatch.setattr(urllib.request, "urlopen", urlopen)
        monkeypatch.setattr(subprocess, "Popen", started)
        viewer = Viewer()
        assert viewer.file("../etc/passwd") is None
        try:
            content, kind = viewer.file("index.html") or (b"", "")
            assert kind.startswith("text/html")
            before = clock.now
            assert viewer.file("re_viewer.js") == (b"viewer", "text/javascript")
            assert clock.now == before, "all were fetched with the first"
            return content
        finally:
            assert killed == [1], "the program ends in any case"

    return run


@pytest.mark.parametrize(("seconds", "since"), [(0.01, 0.0), (5.0, 0.0), (0.01, 12.0), (10.0, 12.0)])
def test_a_program_that_takes_its_time_is_waited_for(fetched, seconds, since):
    """It has 30 MB, unpacked on a busy machine."""
    assert fetched(seconds, since) == b"viewer"


@pytest.mark.parametrize(
    ("seconds", "since", "code", "longest"), [(1e9, 0.0, None, 60.0), (0.01, 1e9, None, 60.0), (0.01, 0.0, 1, 0.0)]
)
def test_a_program_that_does_not_answer_is_given_up_within_a_minute_and_one_that_ended_at_once(
    fetched, clock, seconds, since, code, longest
):
    with pytest.raises(SafedpaError, match="did not serve the viewer"):
        fetched(seconds, since, code)
    assert clock.now <= longest
