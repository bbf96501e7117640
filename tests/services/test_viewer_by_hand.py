"""How long the page waits for the viewer's files: the network is made up, and the clock goes by the test."""

from __future__ import annotations

import io
import urllib.error
from types import SimpleNamespace
from typing import Any

import pytest

from safedpa.errors import SafedpaError
from safedpa_services.web import viewer as module


class Net:
    """Answers after ``seconds``, or not within the time that is asked for; from ``since`` on somebody listens."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, seconds: float, since: float = 0.0) -> None:
        self.now, self.seconds, self.since = 0.0, seconds, since
        monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: self.now, sleep=self.sleep))
        monkeypatch.setattr(module.urllib.request, "urlopen", self.urlopen)
        self.process: Any = SimpleNamespace(poll=lambda: None)

    def sleep(self, seconds: float) -> None:
        self.now += seconds

    def urlopen(self, _address: str, timeout: float) -> Any:
        if self.now < self.since:
            raise urllib.error.URLError("connection refused")
        self.now += min(self.seconds, timeout)
        if self.seconds > timeout:
            raise urllib.error.URLError("timed out")
        return io.BytesIO(b"viewer")


@pytest.mark.parametrize(("seconds", "since"), [(0.01, 0.0), (5.0, 0.0), (0.01, 12.0), (10.0, 12.0)])
def test_a_program_that_takes_its_time_is_waited_for(
    seconds: float, since: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is 30 MB, unpacked on a machine that is busy."""
    net = Net(monkeypatch, seconds, since)
    assert module._fetch("http://127.0.0.1:1/x", net.process) == b"viewer"


@pytest.mark.parametrize(("seconds", "since"), [(1e9, 0.0), (0.01, 1e9)])
def test_a_program_that_says_nothing_is_given_up_within_a_minute(
    seconds: float, since: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    net = Net(monkeypatch, seconds, since)
    with pytest.raises(SafedpaError, match="did not serve its viewer"):
        module._fetch("http://127.0.0.1:1/x", net.process)
    assert net.now <= 60.0


def test_a_program_that_has_ended_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    net = Net(monkeypatch, 0.01)
    net.process.poll = lambda: 1
    with pytest.raises(SafedpaError, match="did not serve its viewer"):
        module._fetch("http://127.0.0.1:1/x", net.process)
    assert net.now == 0.0
