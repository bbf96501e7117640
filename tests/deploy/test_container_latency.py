"""Sense to act of containers: what is read of logs and times; the containers themselves run in ``tests/fleet``."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "deploy"))

import container_latency
from container_chain import account

ROOT = Path(__file__).resolve().parents[2]
ACCOUNT = {"ticks": 100, "watchdog_ticks": 2, "collisions": 0, "latency_us": {"p50": 900.0, "p99": 3000.0}}


def test_percentiles_and_what_is_late() -> None:
    times = [1000.0 * number for number in range(1, 100)]
    found = account(times, 100, 20.0)
    assert (found["p50"], found["p99"], found["p999"]) == (50_000.0, 99_000.0, 99_000.0)
    assert found["late_share"] == pytest.approx(0.5), "49 that took longer than 50 ms, and one that never came"


def test_the_account_is_the_last_one_of_the_log() -> None:
    lines = ['{"event": "robot.ready"}', json.dumps({**ACCOUNT, "ticks": 1}), "no json", json.dumps(ACCOUNT), "7"]
    assert container_latency.account_in(lines) == ACCOUNT


def test_a_robot_without_an_account_is_reported_with_its_last_words() -> None:
    with pytest.raises(RuntimeError, match="no account of its drive; its last words: one two"):
        container_latency.account_in(["none", "one", "two"])


def test_the_chain_runs_before_and_after_the_loop_with_the_limits_of_its_containers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ran: list[list[str]] = []

    def run(words: Any, **_: Any) -> subprocess.CompletedProcess[str]:
        ran.append(list(words))
        said = "container"
        if "send" in words:
            said = json.dumps({"p50": 800.0, "p99": 1500.0, "p999": 2000.0, "late_share": 0.0})
        elif "logs" in words:
            said = json.dumps(ACCOUNT)
        return subprocess.CompletedProcess(words, 0, said, "")

    monkeypatch.setattr(container_latency.subprocess, "run", run)
    monkeypatch.setattr(container_latency.time, "sleep", lambda _: None)
    monkeypatch.setattr(container_latency.os, "environ", dict(container_latency.os.environ))
    found = container_latency.measured(600.0, 20.0)
    assert (found["ratio_p99"], found["watchdog_ticks"]) == (2.0, 2)
    what = ["send" if "send" in words else "robot" if words[-1] == "robot" and "up" in words else "" for words in ran]
    assert [each for each in what if each] == ["send", "robot", "send"]
    services = yaml.safe_load((ROOT / "docker-compose.yml").read_text(encoding="utf-8"))["services"]
    sent = next(words for words in ran if "send" in words)
    for option, key in (("--cpus", "cpus"), ("--cpu-shares", "cpu_shares"), ("--memory", "mem_limit")):
        assert sent[sent.index(option) + 1] == str(services["adaptation"][key])
    assert sent[-2:] == ["60", "20"]
    relays = [words[-2:] for words in ran if "relay" in words]
    assert relays[:3] == [["bare/state", "bare/latent"], ["bare/latent", "bare/wish"], ["bare/wish", "bare/action"]]
    assert ran[-1][-3:] == ["--remove-orphans", "--timeout", "3"]


def test_an_error_of_the_engine_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(words: Any, **_: Any) -> subprocess.CompletedProcess[str]:
        return subprocess.CompletedProcess(words, 1, "", "Traceback\n  line\nno engine answers\n")

    monkeypatch.setattr(container_latency.subprocess, "run", run)
    monkeypatch.setattr(container_latency.os, "environ", dict(container_latency.os.environ))
    monkeypatch.setattr(sys, "argv", ["container_latency", "--seconds", "1"])
    with pytest.raises(SystemExit) as end:
        container_latency.main()
    assert end.value.code == 1
    said = capsys.readouterr().err
    assert said.startswith("container_latency: ")
    assert said.endswith("no engine answers\n")
    assert said.count("\n") == 1


@pytest.mark.parametrize(("seconds", "rate"), [(float("nan"), 20.0), (-1.0, 20.0), (0.0, 20.0), (5.0, 0.0), (5.0, 2e3)])
def test_impossible_times_are_refused_before_anything_is_started(
    seconds: float, rate: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(container_latency.subprocess, "run", lambda *_, **__: pytest.fail("started"))
    with pytest.raises(ValueError, match="wanted one tick at least"):
        container_latency.measured(seconds, rate)


def test_without_messages_there_is_no_percentile() -> None:
    with pytest.raises(TimeoutError, match="none of 100"):
        account([], 100, 20.0)
    nothing = {**ACCOUNT, "latency_us": {"p50": None, "p99": None}}
    with pytest.raises(RuntimeError, match="no action reached the robot in 100 ticks"):
        container_latency.account_in([json.dumps(nothing)])
