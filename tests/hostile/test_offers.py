"""Offered models cost the loop nothing, whatever they hold: they are tried in a process of their own."""

import argparse
import math
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import pytest

from safedpa.adaptation import AdaptationNode
from safedpa.bus import TAKEOVER, AbstractNode, Answer, ModelMessage, StateMessage
from safedpa.bus.service.model_versions import ModelVersions
from safedpa.bus.service.sandbox import JobHandle, JobProcess
from safedpa.dynamics import fingerprint, load_model, parse_model, write_model
from safedpa.effects.library import effects_of
from safedpa.errors import InputError
from safedpa_services.model_trial import run_model_trial

CAR = load_model("car")
DOCUMENT = write_model(CAR) + '\n[[effects]]\nname = "steering_offset"\nangle = 0.01\n'
NEW = fingerprint(parse_model(DOCUMENT))
_PATIENCE = 300.0
_BEHIND_OTHERS = 20.0
"""So much slower goes the clock of a process apart here: behind all others of a busy machine it hardly runs."""
OPTIONS = argparse.Namespace(model="car", controller="", settings="car", margin="", orders="", off=False)
BOMBS = {
    "a key of 50 000 parts": "a" + ".a" * 50_000 + " = 1\n",
    "a key of 30 000 parts": "a" + ".a" * 30_000 + " = 1\n",
    "arrays in arrays": "x = " + "[" * 60_000,
    "a number of 60 000 digits": "period = " + "1" * 60_000,
    "a string without an end": '"""\\' * 10_000,
    "60 000 lines": "\n" * 60_000,
    "4 MB": "#" * 4_000_000,
    "names of 60 000 letters": "a" * 60_000 + " = 1",
}
"""The first is the one that froze a machine for 22 s."""


def state_at(tick: int) -> StateMessage:
    return StateMessage(
        epoch=1,
        tick=tick,
        robot_time=0.05 * tick,
        publish_time=0.0,
        values=(0.0, 0.0, 0.0, 0.0),
        applied=(0.0, 0.0),
        applied_by="filter",
        period=0.05,
        lockstep=False,
        goal=(1.0, 1.0),
        obstacles=(),
        field=(-4.0, 4.0, -4.0, 4.0),
        footprint=(0.1, 0.4, 0.1),
    )


@pytest.fixture
def apart() -> Iterator[JobProcess]:
    found = JobProcess("safedpa_services.model_trial:run_model_trial", lambda: time.monotonic() / _BEHIND_OTHERS)
    yield found
    found.close()


def turn(node: AbstractNode, tick: int) -> Any:
    outputs = dict(node.step("r1", state_at(tick), {}))
    outputs.update(node.afterwards("r1"))
    return outputs.get(TAKEOVER)


def tried_by(apart: JobProcess, node: AbstractNode) -> Callable[[str, ModelMessage], JobHandle]:
    """Has offers to a node tried in the process apart, as a service does."""
    return lambda robot, offer: apart.submit((node.name, OPTIONS, robot, offer, node.newest(robot), node.agreed(robot)))


def test_a_turn_with_a_bomb_takes_no_longer_than_reading_a_good_model(apart, offer_of):
    """The best of three goes at each: what a busy machine adds to one turn is not the bomb's."""
    good = math.inf
    for _ in range(5):
        began = time.thread_time()
        parse_model(DOCUMENT)
        good = min(good, time.thread_time() - began)
    node = AdaptationNode(CAR)
    node.use_sandbox(tried_by(apart, node))
    turn(node, 0)
    ticks, longest = count(1), dict.fromkeys(BOMBS, math.inf)
    for change, name in enumerate([*BOMBS] * 3, 1):
        answer, spent = None, []
        node.hear("r1", offer_of(BOMBS[name], change=change))
        until = time.monotonic() + _PATIENCE
        while answer is None and time.monotonic() < until:
            began = time.thread_time()
            answer = turn(node, next(ticks))
            spent.append(time.thread_time() - began)
            time.sleep(0.005)
        assert answer is not None, name
        assert (answer.state, answer.change) == ("refused", change)
        longest[name] = min(longest[name], max(spent))
    assert max(longest.values()) < 20.0 * good, longest
    assert node.model_of("r1") == fingerprint(CAR)


def test_a_good_offer_is_taken_as_before(apart: JobProcess, offer_of: Callable[..., ModelMessage]) -> None:
    node = AdaptationNode(CAR)
    node.use_sandbox(tried_by(apart, node))
    turn(node, 0)
    node.hear("r1", offer_of(DOCUMENT, NEW))
    answer, ticks, until = None, count(1), time.monotonic() + _PATIENCE
    while answer is None and time.monotonic() < until:
        answer = turn(node, next(ticks))
        time.sleep(0.005)
    assert answer is not None
    assert answer.state == "ready", answer.reason
    assert answer.fingerprint == NEW


@pytest.mark.parametrize("service", ["adaptation", "policy", "safety_filter"])
def test_each_service_tries_an_offer_as_it_would_take_it(service: str, offer_of: Callable[..., ModelMessage]) -> None:
    """Margins are the filter's business: without one it refuses, as in the loop."""
    work = (service, OPTIONS, "r1", offer_of(DOCUMENT, NEW), state_at(3), None)
    if service == "safety_filter":
        with pytest.raises(InputError, match="margin: missing"):
            run_model_trial(work)
    else:
        assert fingerprint(parse_model(run_model_trial(work)["document"])) == NEW


def test_a_model_that_takes_more_than_a_tick_has_is_refused(offer_of, monkeypatch):
    step = AdaptationNode.step

    def slow(self: AdaptationNode, robot: str, state: StateMessage, inputs: Any) -> Any:
        until = time.process_time() + (0.02 if self.model_of(robot) == NEW else 0.0)
        while time.process_time() < until:
            continue
        return step(self, robot, state, inputs)

    monkeypatch.setattr(AdaptationNode, "step", slow)
    with pytest.raises(Exception, match=r"takes .* ms of CPU time"):
        run_model_trial(("adaptation", OPTIONS, "r1", offer_of(DOCUMENT, NEW), state_at(3), None))


def test_a_car_with_every_effect_free_is_a_bounded_matter(offer_of: Callable[..., ModelMessage]) -> None:
    """More effects and free parameters than any library has are refused by their number."""
    document = write_model(CAR)
    for item in effects_of("car").values():
        document += f'\n[[effects]]\nname = "{item.name}"\n'
        document += "".join(f"{p.name} = {{ value = {p.start!r}, free = true }}\n" for p in item.parameters)
    assert len(document) < 65_536
    with pytest.raises(InputError):  # not of this fingerprint; what costs time was done before
        run_model_trial(("adaptation", OPTIONS, "r1", offer_of(document), state_at(3), None))


# the process apart


def spins(work: object) -> dict[str, Any]:
    while True:
        continue


def eats(work: object) -> dict[str, Any]:
    return {"document": str(len(bytes(4 << 30)))}


def dies(work: object) -> dict[str, Any]:
    os.abort()


def writes(work: object) -> dict[str, Any]:
    Path(str(work)).write_text("x" * 10_000, encoding="utf-8")
    return {}


def reports_its_niceness(work: object) -> dict[str, Any]:
    return {"nice": os.nice(0), "policy": os.sched_getscheduler(0)}


@pytest.mark.long
@pytest.mark.parametrize(
    ("function", "phrase"),
    [("spins", "more than 5 s of processor time"), ("eats", ""), ("dies", "ended its process"), ("writes", "")],
)
def test_what_takes_too_much_is_ended_and_the_next_work_is_done(function: str, phrase: str, tmp_path: Path) -> None:
    apart = _apart(function, tmp_path, clock=lambda: time.monotonic() / _BEHIND_OTHERS)
    try:
        outcome = apart.submit(str(tmp_path / "file")).outcome(wait=True)
        assert outcome is not None
        assert phrase in outcome["problem"]
        assert outcome["problem"]
        assert not (tmp_path / "file").exists() or (tmp_path / "file").stat().st_size == 0
    finally:
        apart.close()


def test_it_runs_behind_everybody_else(tmp_path: Path) -> None:
    apart = _apart("reports_its_niceness", tmp_path, clock=lambda: time.monotonic() / _BEHIND_OTHERS)
    try:
        assert apart.submit(None).outcome(wait=True) == {"nice": 19, "policy": os.SCHED_OTHER}
    finally:
        apart.close()


def test_each_answer_comes_while_the_process_waits_for_more_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Not when its output is full or closed: whatever the environment says of what Python holds back."""
    monkeypatch.delenv("PYTHONUNBUFFERED", raising=False)
    apart = _apart("reports_its_niceness", tmp_path, clock=lambda: time.monotonic() / _BEHIND_OTHERS)
    try:
        for number in range(3):
            assert (apart.submit(number).outcome(wait=True) or {}).get("nice") == 19
        assert apart.pid
    finally:
        apart.close()


def test_handing_in_waits_two_milliseconds_at_most_even_where_no_process_reads(tmp_path, monkeypatch):
    slept: list[float] = []
    apart = _apart("spins", tmp_path, clock=lambda: sum(slept))
    monkeypatch.setattr("safedpa.bus.service.sandbox.time.sleep", slept.append)
    try:
        waited = []
        for _ in range(40):
            before = sum(slept)
            apart.submit("x" * 65_536)
            waited.append(sum(slept) - before)
        assert 0.001 < max(waited) < 0.0025
    finally:
        apart.close()


def test_giving_up_waits_for_no_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a busy machine a process at the lowest priority takes tens of milliseconds to die, with much memory more."""
    now = [0.0]
    apart = _apart("spins", tmp_path, clock=lambda: time.monotonic() + now[0])
    ticket, first = apart.submit(None), apart.pid
    monkeypatch.setattr("subprocess.Popen.wait", lambda *_, **__: pytest.fail("the loop waited for a process to die"))
    now[0] += 30.0
    assert "could not be tried" in (ticket.outcome() or {})["problem"]
    assert apart.pid == 0
    monkeypatch.undo()
    until = time.monotonic() + 30.0
    while Path(f"/proc/{first}").exists() and time.monotonic() < until:
        apart.take(0)
        time.sleep(0.01)
    assert not Path(f"/proc/{first}").exists(), "it stays as a zombie"
    apart.close()


def test_works_behind_one_that_takes_too_long_fail_at_once_and_end_no_other(tmp_path: Path) -> None:
    now = [0.0]
    apart = _apart("spins", tmp_path, clock=lambda: time.monotonic() + now[0])
    try:
        first, second, third = (apart.submit(number) for number in range(3))
        now[0] += 30.0
        assert "within 20 s" in (first.outcome() or {})["problem"]
        later, process = apart.submit("later"), apart.pid
        for ticket in (second, third):
            assert "another work" in (ticket.outcome() or {})["problem"]
        assert later.outcome() is None
        assert apart.pid == process != 0
    finally:
        apart.close()


def test_many_that_do_not_die_are_not_joined_by_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    apart = _apart("spins", tmp_path)
    monkeypatch.setattr("subprocess.Popen.poll", lambda _: None)
    for _ in range(4):
        apart.submit(None)
        apart.kill()
    assert "have not exited" in (apart.submit(None).outcome() or {})["problem"]
    assert apart.pid == 0
    monkeypatch.undo()
    apart.close()


def _apart(function: str, folder: Path, clock: Callable[[], float] = time.monotonic) -> JobProcess:
    """With a function of this file, which the process finds as a module of its own."""
    source = Path(__file__).read_text(encoding="utf-8")
    begin, end = (
        source.index("def spins"),
        source.index('@pytest.mark.long\n@pytest.mark.parametrize(\n    ("function"'),
    )
    head = "import os\nimport resource\nfrom pathlib import Path\nfrom typing import Any\n\n"
    head += "usual = resource.setrlimit\n"  # a fifth of the seconds of a processor
    head += "fifth = lambda kind, most: (most[0] // 5,) * 2 if kind == resource.RLIMIT_CPU else most\n"
    head += "resource.setrlimit = lambda kind, most: usual(kind, fifth(kind, most))\n\n\n"
    (folder / "works_apart.py").write_text(head + source[begin:end], encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(folder))
        return JobProcess(f"works_apart:{function}", clock)


def test_loading_what_was_found_good_is_spread(offer_of: Callable[..., ModelMessage]) -> None:
    """Trials that end together do not hold up a turn together: after each load the loop has as long for others."""
    now = [0.0]

    class Tried:
        def outcome(self, *, wait: bool = False) -> dict[str, Any]:
            return {"document": "good"}

    def load(robot: str, offer: ModelMessage) -> str:
        now[0] += 0.014
        return "new"

    versions: ModelVersions[str] = ModelVersions("policy", "held", "0" * 12, load, clock=lambda: now[0])
    versions.submit = lambda robot, offer: Tried()
    robots = [f"r{number}" for number in range(8)]
    for robot in robots:
        versions.hear(robot, offer_of("document"))
    for turn_number in range(1, 9):
        before = now[0]
        answered = [robot for robot in robots if versions.answer(robot, state_at(turn_number)) is not None]
        assert answered == [robots[turn_number - 1]]
        assert now[0] - before == pytest.approx(0.014)
        now[0] += 0.0141


def test_in_lockstep_the_answer_depends_on_no_clock(offer_of: Callable[..., ModelMessage]) -> None:
    """What a robot in lockstep is answered depends on no clock."""
    versions: ModelVersions[str] = ModelVersions("policy", "held", "0" * 12, lambda *_: "new", clock=time.monotonic)

    class Tried:
        def outcome(self, *, wait: bool = False) -> dict[str, Any]:
            assert wait
            return {"document": "good"}

    versions.submit = lambda robot, offer: Tried()
    for robot in ("r1", "r2", "r3"):
        versions.hear(robot, offer_of("document"))
        answer = versions.answer(robot, replace(state_at(1), lockstep=True))
        assert answer is not None
        assert answer.state == "ready"


def test_a_repaired_version_needs_no_trial(offer_of: Callable[..., ModelMessage]) -> None:
    """What is in force already is not loaded again."""
    versions: ModelVersions[str] = ModelVersions("policy", "held", "0123456789ab", lambda robot, offer: "other")
    versions.submit = lambda robot, offer: pytest.fail("nothing is to be tried")
    versions.adopt_model("r1", Answer(ok=True, sentence="", fingerprint="0123456789ab"))
    versions.hear("r1", offer_of("document"))
    answer = versions.answer("r1", state_at(1))
    assert answer is not None
    assert answer.state == "ready"
