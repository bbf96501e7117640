"""Rows that start processes: sense to act and the start. What they ask for, without starting any."""

from __future__ import annotations

import json
import subprocess
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from safedpa.errors import SafedpaError
from safedpa_lab.benchmarks import latency
from safedpa_lab.benchmarks.first_page import answers, seconds_to_pages
from safedpa_lab.benchmarks.results import Effort, Floor, Row
from safedpa_lab.benchmarks.rows import sense_to_act, start

LOOP = {"p50": 900.0, "p99": 1210.0, "p999": 3000.0, "watchdog_ticks": 2}


def _sense_to_act(monkeypatch: pytest.MonkeyPatch, effort: Effort, watched: Any) -> tuple[Row, list[Any]]:
    asked: list[Any] = []

    def both(seconds: float, rate: float) -> dict[str, Any]:
        asked.append((seconds, rate))
        chain = {"p50": 800.0, "p99": 10.0 * rate + 800.0, "p999": 2000.0, "late_share": 1e-6 * rate}
        return {"real_loop_us": LOOP, "bare_chain_us": chain}

    monkeypatch.setattr(sense_to_act, "latency_benchmark", both)
    monkeypatch.setattr(sense_to_act, "real_loop", watched)
    return sense_to_act.measure(effort), asked


def test_the_loop_is_compared_with_the_bare_chain_of_its_run(monkeypatch: pytest.MonkeyPatch) -> None:
    looked: list[Any] = []

    def watched(seconds: float, rate: float, *, watched: bool) -> dict[str, Any]:
        looked.append((seconds, rate, watched))
        return {**LOOP, "watchdog_ticks": 0}

    row, asked = _sense_to_act(monkeypatch, Effort(full=True), watched)
    assert asked == [(600.0, 20.0), (600.0, 200.0)]
    assert looked == [(120.0, 20.0, True)]
    wanted = [(target.wanted, target.got) for target in row.targets]
    assert wanted == [(1200.0, 1210.0), (0.0, 2.0), (3360.0, 1210.0), (0.0, 2.0), (1200.0, 1210.0), (0.0, 0.0)]
    assert [target.reached for target in row.targets] == [False, False, True, False, False, True]
    assert row.targets[0].floor == Floor("the bare chain", 1000.0)
    assert not row.targets[0].forbidden
    assert [target.floor for target in row.targets[1:4:2]] == [
        Floor("as late as the bare chain", 0.0),
        Floor("as late as the bare chain", 24.0),
    ]
    assert [target.forbidden for target in row.targets[1:4:2]] == [False, True]
    assert [set(entry.figures) for entry in row.peers] == [{"p50", "p99", "p999"}] * 2
    assert [entry.problem for entry in row.ours] == ["20 Hz", "200 Hz", "20 Hz, watched"]
    assert "workbench" in row.ours[-1].note


def test_the_chain_runs_before_and_after_the_loop_and_counts_late_messages(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[Any] = []

    def times(seconds: float, rate: float) -> list[float]:
        told.append(("chain", seconds, rate))
        return [1000.0] * (round(seconds * rate) - 2) + [5001.0]  # one is late, one never comes

    def loop(seconds: float, rate: float) -> dict[str, float]:
        told.append(("loop", seconds, rate))
        return dict(LOOP)

    monkeypatch.setattr(latency, "bare_times", times)
    monkeypatch.setattr(latency, "real_loop", loop)
    found = latency.latency_benchmark(600.0, 200.0)
    assert told == [("chain", 60.0, 200.0), ("loop", 600.0, 200.0), ("chain", 60.0, 200.0)]
    assert found["bare_chain_us"] == {
        "p50": 1000.0,
        "p99": 1000.0,
        "p999": 1000.0,
        "late_share": pytest.approx(4 / 24000),
    }
    told.clear()
    latency.latency_benchmark(20.0, 20.0)
    assert told[0] == ("chain", 10.0, 20.0)


def test_a_chain_from_which_nothing_arrives_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(latency, "bare_times", lambda *_: [])
    with pytest.raises(SafedpaError, match="got none of 40 messages"):
        latency.bare_chain(2.0, 20.0)


def test_a_watched_loop_that_does_not_come_up_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    def watched(*_: Any, **__: Any) -> dict[str, Any]:
        raise SafedpaError("safedpa up: ran without workbench")

    row, _ = _sense_to_act(monkeypatch, Effort(), watched)
    assert "without workbench" in row.ours[-1].missing
    assert len(row.targets) == 4
    quick, asked = _sense_to_act(monkeypatch, Effort(quick=True), watched)
    assert asked == [(2.0, 20.0)]
    assert len(quick.ours) == 1


def test_a_watched_loop_needs_every_watching_service(monkeypatch: pytest.MonkeyPatch) -> None:
    services = [{"name": name} for name in ("robot", "recorder", "diagnosis", "dashboard", "workbench")]

    def run(command: list[str], **_: Any) -> SimpleNamespace:
        there = services if "--headless" not in command and "7.0" in command else services[:3]
        summary = {"services": there, "latency_us": LOOP, "watchdog_ticks": 2}
        return SimpleNamespace(returncode=0, stdout=json.dumps(summary))

    monkeypatch.setattr(subprocess, "run", run)
    assert latency.real_loop(7.0, 20.0, watched=True) == LOOP
    assert latency.real_loop(5.0, 20.0) == LOOP
    with pytest.raises(SafedpaError, match="without dashboard, workbench"):
        latency.real_loop(5.0, 20.0, watched=True)


class _Site(BaseHTTPRequestHandler):
    """``/page`` is a page, ``/door`` lets in whoever comes back with its cookie, nothing else is there."""

    def do_GET(self) -> None:
        let_in = self.path == "/page" or "key=1" in (self.headers.get("Cookie") or "")
        at_door = self.path == "/door" and not let_in
        self.send_response(303 if at_door else 200 if let_in else 404)
        if at_door:
            self.send_header("Set-Cookie", "key=1; Path=/")
            self.send_header("Location", "/inside")
        self.send_header("Content-Length", "0")
        self.end_headers()

    def log_message(self, *_: object) -> None:
        """Says nothing."""


@pytest.fixture
def site() -> Iterator[str]:
    server = ThreadingHTTPServer(("127.0.0.1", 0), _Site)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    server.server_close()


def test_a_page_answers_when_a_browser_would_see_it(site: str) -> None:
    assert answers(f"{site}/page")
    assert answers(f"{site}/door")
    assert not answers(f"{site}/absent")
    assert not answers("http://127.0.0.1:9/page")


def _up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, program: str) -> None:
    """A stand-in for ``safedpa up``."""
    package = tmp_path / "safedpa_services"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "__main__.py").write_text(program, encoding="utf-8")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))


@pytest.mark.long
def test_the_first_page_is_waited_for(site: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = f"recording r\\nlive view {site}/page\\nworkbench {site}/door\\n"
    _up(tmp_path, monkeypatch, f"import sys, time\nsys.stderr.write('{words}')\nsys.stderr.flush()\ntime.sleep(60)\n")
    found = seconds_to_pages()
    assert set(found) == {"live view", "workbench"}
    assert all(0.0 < seconds < 60.0 for seconds in found.values())


@pytest.mark.long
def test_a_start_that_ends_or_shows_nothing_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _up(tmp_path, monkeypatch, "import sys\nsys.exit('no room for a page')\n")
    with pytest.raises(SafedpaError, match="ended with exit code 1"):
        seconds_to_pages()
    (tmp_path / "safedpa_services" / "__main__.py").write_text("import time\ntime.sleep(60)\n", encoding="utf-8")
    clock = time.monotonic
    monkeypatch.setattr(time, "monotonic", lambda: 100.0 * clock())  # a minute is over after 0.6 s
    began = clock()
    with pytest.raises(SafedpaError, match="no answer of live view, workbench"):
        seconds_to_pages()
    assert clock() - began > 0.3


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.processes
def test_the_start_has_a_target_of_each_kind(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is measured is real, but for the pages, which need a browser's packages."""
    monkeypatch.setattr(start, "seconds_to_pages", lambda: {"live view": 4.5, "workbench": 5.0})
    row = start.measure(Effort(quick=True))
    figures = {entry.name: entry.figures.get("seconds") for entry in row.ours}
    got = {target.what: (target.wanted, target.got) for target in row.targets}
    assert got["start to the first action"] == (2.0, figures["safedpa up to the first action"])
    assert got["start to the live view"] == (4.0, 4.5)
    assert got["safedpa compare of a recording"] == (2.0, figures["safedpa compare"])
    assert got["import safedpa"] == (0.15, figures["import safedpa"])
    acting = {figures[f"import of {name}"] for name in ("adaptation", "policy", "safety_filter")}
    assert row.targets[0].floor is not None
    assert row.targets[0].floor.value == max(acting), "an action needs no dashboard"
    assert row.targets[1].floor == Floor("import of dashboard", figures["import of dashboard"])
    memory = {entry.name: entry.figures["mib"] for entry in row.ours if entry.problem == "memory"}
    assert min(memory.values()) > 5.0
    assert len(memory) >= 5
