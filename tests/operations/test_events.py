"""Events: one catalogue, one line per change, readable and rate limited."""

import ast
import json
from pathlib import Path
from typing import Any

import pytest

from safedpa.bus import TAKEOVER, VERDICT, Bus, MemoryBroker, MemoryTransport, ServiceLoop, TakeoverMessage
from safedpa.bus.logging import KINDS, log_event
from safedpa.bus.service.service_log import ServiceLog
from safedpa_services.supervisor.child import Child
from safedpa_services.supervisor.log_warnings import LogWarnings, readable

ROOT = Path(__file__).resolve().parents[2]
SOURCES = [path for folder in ("shared", "services", "sim") for path in (ROOT / folder).rglob("*.py")]
LOOP = ("adaptation", "policy", "safety_filter")


def test_the_catalogue_lists_exactly_the_events_that_are_written() -> None:
    texts = {path: path.read_text(encoding="utf-8") for path in SOURCES if path.name != "events.py"}
    written = set()
    for text in texts.values():
        for node in ast.walk(ast.parse(text)) if "log_event(" in text else ():
            called = getattr(node, "func", None)
            if isinstance(node, ast.Call) and getattr(called, "id", "") == "log_event":
                first = node.args[0]
                written |= {first.value} if isinstance(first, ast.Constant) else set()
    assert written
    assert written <= set(KINDS), "not in the catalogue: add it to safedpa/bus/logging.py, run docs/generate.py"
    everything = "".join(texts.values())
    assert [kind for kind in KINDS if f'"{kind}"' not in everything] == [], "in the catalogue, but never written"


@pytest.fixture
def service_log() -> tuple[ServiceLog, list[dict[str, Any]]]:
    events: list[dict[str, Any]] = []
    return ServiceLog("safety_filter", lambda kind, sentence, **more: events.append({"kind": kind, **more})), events


def test_verdicts_are_logged_where_they_change(fleet: Any, service_log: tuple[ServiceLog, list[dict[str, Any]]]):
    reported, events = service_log
    heard = Bus(MemoryTransport(fleet.broker), "test").inbox((VERDICT,))
    statuses = ["passed", "fallback", "fallback", "corrected", "passed", "stopped", "stopped", "passed", "disabled"]
    for status in statuses:
        fleet.tick("r1", state={}, verdict={"status": status})
    for item in heard.take(0.0):
        reported.notice(item.robot, {VERDICT: item.message})
    kinds = ["fallback_entered", "fallback_left", "stopped", "released", "disabled"]
    assert [event["kind"] for event in events] == [f"filter.{kind}" for kind in kinds]
    assert [event["tick"] for event in events] == [1, 3, 5, 7, 8]
    assert [event["level"] for event in events] == ["warning", "info", "warning", "info", "warning"]
    assert all(event["robot"] == "r1" and event["service"] == "safety_filter" for event in events)
    assert {event["kind"] for event in events} <= set(KINDS)


def test_every_event_of_a_service_log_is_in_the_catalogue(service_log: tuple[ServiceLog, list[dict[str, Any]]]) -> None:
    reported, events = service_log
    reported.met("r1", 0, again=False)
    reported.met("r1", 0, again=True)
    reported.refused("nonsense")
    reported.refused("two of them", "r1", 3, second=True)
    reported.forgot("r1")
    stamp = {"epoch": 1, "tick": 2, "robot_time": 0.1, "publish_time": 0.0}
    for state in ("ready", "taken", "refused"):
        message = TakeoverMessage(**stamp, service="policy", change=1, fingerprint="ab", state=state, reason="")
        reported.notice("r1", {TAKEOVER: message})
    assert len({event["kind"] for event in events}) == 8
    assert {event["kind"] for event in events} <= set(KINDS)


def test_a_service_logs_the_robots_it_meets_and_what_it_refuses(fleet, service_log):
    from safedpa.adaptation import AdaptationNode
    from safedpa.dynamics import load_model

    reported, events = service_log
    bus = Bus(MemoryTransport(fleet.broker), "test")
    loop = ServiceLoop(AdaptationNode(load_model("car")), bus, clock=lambda: fleet.now, service_log=reported)
    for epoch in (7, 8):
        fleet.tick("r1", state={"lockstep": True, "epoch": epoch}, verdict={})
        for _ in range(3):
            loop.turn(0.0)
    MemoryTransport(fleet.broker).put("safedpa/test/r1/state", b"garbage", never_drop=False)
    loop.turn(0.0)
    kinds = [event["kind"] for event in events]
    assert kinds == ["robot.met", "robot.second_refused", "message.refused"]
    assert events[-1]["robot"] == "r1"


def test_an_experiment_in_one_process_writes_nothing(fleet: Any, capfd: pytest.CaptureFixture[str]) -> None:
    from safedpa.adaptation import AdaptationNode
    from safedpa.dynamics import load_model

    loop = ServiceLoop(AdaptationNode(load_model("car")), Bus(MemoryTransport(MemoryBroker()), "test"))
    loop.turn(0.0)
    ServiceLog.silent().met("r1", 0, again=False)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(("wanted", "text"), [("", False), ("json", False), ("text", True)])
def test_a_pipe_gets_json_unless_text_is_asked_for(wanted, text, monkeypatch, capfd):
    monkeypatch.setenv("SAFEDPA_LOG", wanted)
    log_event("robot.met", "hello", robot=f"robot of this test {wanted}", tick=3, service="a test")
    line = capfd.readouterr().err
    assert line.count("\n") == 1
    if text:
        assert " info robot.met: hello" in line
        assert "tick 3" in line
    else:
        event = json.loads(line)
        assert (event["kind"], event["tick"], event["level"]) == ("robot.met", 3, "info")


def child(folder: Path, name: str) -> Child:
    return Child(name, "no_module", (), folder / f"{name}.log")


def line(**event: Any) -> str:
    return (
        json.dumps({"time": 1.0, "level": "warning", "kind": "k", "sentence": "s", "service": "policy", **event}) + "\n"
    )


def test_up_prints_warnings_once_and_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr("safedpa_services.supervisor.log_warnings.time.monotonic", lambda: now[0])
    reported: list[str] = []
    policy, recorder = child(tmp_path, "policy"), child(tmp_path, "recorder")
    warnings = LogWarnings((policy, recorder), tmp_path, reported.append)
    warnings.look()
    now[0] += 1.0
    assert reported == [], "no log, no warning"
    policy.log.write_text(
        line(level="info")
        + "a trace back\n"
        + "{no json\n"
        + line(robot="r1", tick=4, sentence="the nominal action is old")
        + "{"
    )
    warnings.look()
    now[0] += 1.0
    assert len(reported) == 1
    assert reported[0].endswith("policy r1 tick 4: the nominal action is old")
    with policy.log.open("a") as log:
        log.write('"level": "error", "sentence": "half a line before", "kind": "x"}\n')
        log.writelines(line(robot="r1") for _ in range(100))
        log.writelines(line(kind="l", sentence=f"{number}") for number in range(100))
    warnings.look()
    now[0] += 1.0
    assert [entry.split(": ", 1)[-1] for entry in reported[2:]] == ["0"], "a similar one was shown less than 5 s ago"
    assert "half a line before" in reported[1]
    recorder.restarts, recorder.cause = 2, "killed by signal 9 (SIGKILL)"
    warnings.look()
    now[0] += 1.0
    assert "recorder was restarted (2 times so far); killed by signal 9 (SIGKILL)" in reported[-1]
    retained = json.loads((tmp_path / "supervisor.log").read_text())
    assert retained["kind"] == "child.restarted"
    assert len(warnings.newest) <= 4


def started_and_ended(one: Child) -> None:
    one.start()
    assert one.pid
    one.end(10.0)


def test_removing_the_folder_of_a_run_ends_no_loop(tmp_path: Path) -> None:
    reported: list[str] = []
    policy = child(tmp_path / "run", "policy")
    policy.restarts = 1
    warnings = LogWarnings((policy,), tmp_path / "run", reported.append)
    policy.restarts = 2
    warnings.look()
    assert "policy was restarted" in reported[0]
    assert policy.last_text() == "it wrote no message"
    started_and_ended(policy)
    assert policy.log.exists(), "the folder is there again, for further messages"


def test_a_readable_line_is_one_line() -> None:
    assert "\n" not in readable({"time": 0.0, "sentence": "a\nb", "service": "x"})
    assert readable({"sentence": "a\nb"}).endswith(" a b")
