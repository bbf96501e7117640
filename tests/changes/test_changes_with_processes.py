"""Real processes over real sessions: a model is changed, and a process is killed in the middle of it."""

import contextlib
import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from safedpa.bus import (
    HEALTH,
    MODEL,
    TAKEOVER,
    Answer,
    Bus,
    HealthMessage,
    ModelMessage,
    ReceivedMessage,
    Request,
    TakeoverMessage,
    ZenohSettings,
    ZenohTransport,
)
from safedpa.dynamics import fingerprint, load_model, parse_model, write_model
from safedpa.safety.defaults import margin_for
from safedpa.safety.margins.calibration import margin_text

pytestmark = [pytest.mark.long, pytest.mark.processes]

SERVICES = ("adaptation", "policy", "safety_filter")
PATIENCE = 240.0
"""s; on a busy machine processes that live for each other take their time."""
DRIVE_SECONDS = "3600"
"""The robot drives for longer than any test waits."""

COORDINATOR = """
import argparse, sys
from pathlib import Path
from safedpa.bus import AbstractNode, HEALTH, MODEL, TAKEOVER, VERDICT, ServiceLoop
from safedpa.bus.service.process import add_bus_options, bus_from_options, run_process
from safedpa.live.change import ModelChanges
from safedpa.live.versions import OfferedEffect, ModelVersion, VersionFolder

class Node(AbstractNode):
    name, inputs, outputs, listens, share = "diagnosis", (), (MODEL,), (TAKEOVER, HEALTH), 0.9

    def __init__(self, first, candidate, folder):
        self.changes, self.candidate = ModelChanges(first, VersionFolder(folder)), candidate

    def step(self, robot, state, inputs):
        if self.changes.fingerprint != self.candidate.fingerprint:
            self.changes.propose(1, {self.candidate.effect: self.candidate})
        message = self.changes.step(state)
        return {} if message is None else {MODEL: message}

    def hear(self, robot, message):
        self.changes.hear(message)

def work(options, stop):
    import json
    first, candidate = json.loads(Path(options.models).read_text())
    node = Node(ModelVersion(**first), OfferedEffect(**candidate), Path(options.models).parent / "versions")
    with bus_from_options(options) as bus:
        bus.answer_requests(lambda robot, request: node.changes.answer(request), "r1")
        ServiceLoop(node, bus).run(stop)
    return 0

parser = argparse.ArgumentParser(prog="coordinator")
add_bus_options(parser)
parser.add_argument("--models")
run_process(work, parser)
"""


class Loop:
    """The processes of one robot's loop and a coordinator; the test listens, asks, kills and restarts."""

    def __init__(self, folder: Path, endpoint: str) -> None:
        self.folder = folder
        self._options = ["--fleet", "changes", "--connect", endpoint]
        self._first, self.candidate = _models()
        (folder / "models.json").write_text(json.dumps([self._first, self.candidate]))
        self.bus = Bus(ZenohTransport(ZenohSettings(listen=(endpoint,))), "changes")
        self._inbox = self.bus.inbox((MODEL, TAKEOVER, HEALTH), keep_all=True)
        self.running: dict[str, subprocess.Popen[bytes]] = {}
        self.using: dict[str, str] = {}
        self.notice: list[ModelMessage | TakeoverMessage] = []

    def drive(self) -> None:
        for name in (*SERVICES, "diagnosis"):
            self.start(name)
        self.until(lambda: set(self.using) >= set(SERVICES))
        self.start("robot")

    def start(self, name: str) -> None:
        command = [sys.executable, "-m", f"safedpa_services.{name}"]
        if name == "diagnosis":
            command = [sys.executable, "-c", COORDINATOR, "--models", str(self.folder / "models.json")]
        if name == "robot":
            command = [sys.executable, "-m", "safedpa_sim.robots", "--load", "chair", "--seed", "1"]
            command += ["--seconds", DRIVE_SECONDS, "--summary", str(self.folder / "robot.json")]
        with (self.folder / f"{name}.log").open("ab") as log:
            environment = {**os.environ, "OMP_NUM_THREADS": "1"}
            self.running[name] = subprocess.Popen([*command, *self._options], stdout=log, stderr=log, env=environment)

    def kill(self, name: str) -> None:
        """With SIGKILL, and at once a new one."""
        self.using.pop(name, None)
        self.running[name].kill()
        self.running[name].wait()
        self.start(name)

    def listen(self) -> None:
        for item in self._inbox.take(0.05):
            if isinstance(item, ReceivedMessage) and isinstance(item.message, HealthMessage):
                if item.message.pid == self.running[item.message.service].pid:
                    self.using[item.message.service] = item.message.model
            elif isinstance(item, ReceivedMessage):
                assert isinstance(item.message, (ModelMessage, TakeoverMessage))
                self.notice.append(item.message)

    def until(self, condition: Any) -> None:
        end = time.monotonic() + PATIENCE
        while not condition():
            self.listen()
            assert time.monotonic() < end, (
                self.using,
                [getattr(m, "step", getattr(m, "state", "")) for m in self.notice],
            )

    def ask(self, do: str) -> Answer | None:
        status = self.bus.request("r1", Request(do="status"), 1.0)
        if status is None:
            return None
        request = Request(do=do, effect="steering_offset", model=status.fingerprint, finding=1, who="test")
        return self.bus.request("r1", request, 1.0)

    def change(self, do: str, moment: str) -> None:
        """Requests a change, and waits until it is at ``moment``, a step that the coordinator publishes.

        Asked again where a trial, which runs behind everybody else, outlasted the offer on a busy machine: nothing has
        changed then, and that moment never comes.
        """
        end = time.monotonic() + PATIENCE
        while True:
            self.notice.clear()
            number = self.begun(do)
            self.until(lambda: self.steps_of(number) & {moment, "drop"})  # noqa: B023  asked before the next turn
            if moment in self.steps_of(number):
                return
            assert time.monotonic() < end, self.notice
            self.until(self.agreed)

    def begun(self, do: str) -> int:
        """The number of a change that begins once nothing speaks against it."""
        answers: list[Answer] = []

        def asked() -> bool:
            answer = self.ask(do)
            answers.extend([answer] if answer is not None and answer.ok else [])
            return bool(answers)

        self.until(asked)
        return answers[0].change

    def steps_of(self, change: int) -> set[str]:
        """The steps of a change that the coordinator has published."""
        return {item.step for item in self.notice if isinstance(item, ModelMessage) and item.change == change}

    def status(self) -> Answer:
        """What the coordinator answers once it is heard."""
        answers: list[Answer] = []

        def asked() -> bool:
            answer = self.bus.request("r1", Request(do="status"), 1.0)
            answers.extend([] if answer is None else [answer])
            return bool(answers)

        self.until(asked)
        return answers[0]

    def agreed(self) -> bool:
        """Whether nothing is under way and all services use what the coordinator has in force."""
        self.listen()
        status = self.bus.request("r1", Request(do="status"), 1.0)
        if status is None or status.pending:
            return False
        return {self.using.get(name) for name in SERVICES} == {status.fingerprint}

    def end(self) -> dict[str, Any]:
        """The robot's account of its drive."""
        self.running["robot"].send_signal(signal.SIGTERM)
        self.running["robot"].wait(PATIENCE)
        account: dict[str, Any] = json.loads((self.folder / "robot.json").read_text())
        return account

    def close(self) -> None:
        for process in self.running.values():
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            process.wait()
        self.bus.close()


def _models() -> tuple[dict[str, Any], dict[str, Any]]:
    """The shipped car, and the same with a steering offset."""
    model = load_model("car")
    changed = parse_model(write_model(model) + '\n[[effects]]\nname = "steering_offset"\nangle = 0.01\n')
    margin = margin_for(model)
    assert margin is not None
    own = margin_text(dataclasses.replace(margin, fingerprint=fingerprint(changed)))
    first = {"fingerprint": fingerprint(model), "document": write_model(model), "margin": margin_text(margin)}
    return first, {
        "effect": "steering_offset",
        "fingerprint": fingerprint(changed),
        "document": write_model(changed),
        "margin": own,
    }


@pytest.fixture
def loop(tmp_path: Path, free_port: int) -> Iterator[Loop]:
    loop = Loop(tmp_path, f"tcp/127.0.0.1:{free_port}")
    try:
        loop.drive()
        yield loop
    finally:
        loop.close()


def test_after_a_kill_during_a_change_all_services_agree_and_the_car_is_safe(loop: Loop) -> None:
    """The worst moments: after the offer, when some have loaded it, and after the decision, before its tick."""
    kills = [("adaptation", "offer"), ("diagnosis", "offer"), ("policy", "take"), ("diagnosis", "take")]
    for name, moment in [*kills, ("safety_filter", "take")]:
        back = loop.status().fingerprint == loop.candidate["fingerprint"]
        loop.change("roll_back" if back else "accept", moment)
        loop.kill(name)
        loop.until(loop.agreed)
    _restart_a_service_while_the_diagnosis_is_dead(loop)
    account = loop.end()
    assert account["collisions"] == 0
    assert account["ticks"] > 50


def _restart_a_service_while_the_diagnosis_is_dead(loop: Loop) -> None:
    """The others tell it what they agreed on."""
    if loop.using["policy"] == loop._first["fingerprint"]:
        loop.change("accept", "take")
        loop.until(lambda: loop.agreed() and loop.using["policy"] != loop._first["fingerprint"])
    loop.running["diagnosis"].kill()
    loop.running["diagnosis"].wait()
    agreed = loop.using["policy"]
    loop.kill("adaptation")
    loop.until(lambda: loop.using.get("adaptation"))
    assert loop.using["adaptation"] == agreed


def test_the_command_line_changes_the_model_and_takes_it_back(loop: Loop) -> None:
    command = [sys.executable, "-m", "safedpa_services"]
    options = ["--fleet", "changes", "--json", "--who", "test", "--connect", loop._options[-1]]
    loop.until(loop.agreed)

    def run(*phrase: str) -> tuple[int, Any, str]:
        notice = [*command, *phrase, *options]
        done = subprocess.run(notice, capture_output=True, text=True, timeout=PATIENCE, check=False)
        return done.returncode, json.loads(done.stdout) if done.stdout else None, done.stderr

    def taken(*phrase: str) -> tuple[int, Any, str]:
        """Asked again where a trial, which runs behind everybody else, outlasted the offer on a busy machine.

        Or where no answer came through in the command's two seconds. Then nothing has changed: all agree on the model
        before.
        """
        before, end = dict(loop.using), time.monotonic() + PATIENCE
        while True:
            code, reported, errors = run(*phrase)
            late = any(reason in f"{reported}{errors}" for reason in ("did not answer", "no diagnosis answers"))
            if code == 0 or not late or time.monotonic() > end:
                return code, reported, errors
            loop.until(loop.agreed)
            assert {name: loop.using[name] for name in SERVICES} == {name: before[name] for name in SERVICES}

    def refused(*phrase: str) -> tuple[int, str]:
        """The answer to what is refused, however often it is asked."""
        end = time.monotonic() + PATIENCE
        while True:
            code, _, errors = run(*phrase)
            if "no diagnosis answers" not in errors or time.monotonic() > end:
                return code, errors

    code, reported, errors = taken("accept", "r1", "steering_offset")
    assert (code, reported["model"]) == (0, loop.candidate["fingerprint"]), errors
    assert "taken by all services" in reported["sentence"]
    loop.until(loop.agreed)
    assert refused("accept", "r1", "wind")[0] == 2, "nothing is proposed for the new model"
    assert "not a candidate" in refused("reject", "r1", "drag")[1]
    code, reported, errors = taken("roll-back", "r1")
    assert (code, reported["model"]) == (0, loop._first["fingerprint"]), errors
    code, errors = refused("roll-back", "r1")
    assert code == 2
    assert "there is no earlier one" in errors
    code, _, errors = run("accept", "r2", "steering_offset")
    assert code == 1
    assert "no diagnosis answers" in errors
