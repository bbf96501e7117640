"""Offered models cost the loop nothing, whatever they hold: they are tried in a process of their own."""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from safedpa.adaptation import AdaptationNode
from safedpa.bus import TAKEOVER, AbstractNode, Answer, ModelMessage, StateMessage
from safedpa.bus.apart import Apart
from safedpa.bus.model_versions import ModelVersions
from safedpa.dynamics import fingerprint, load_model, parse_model, write_model
from safedpa.effects.library import effects_of
from safedpa.errors import InputError
from safedpa_services.serving import _hand_in
from safedpa_services.trying import tried

CAR = load_model("car")
DOCUMENT = write_model(CAR) + '\n[[effects]]\nname = "steering_offset"\nangle = 0.01\n'
NEW = fingerprint(parse_model(DOCUMENT))
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
def apart() -> Iterator[Apart]:
    found = Apart("safedpa_services.trying:tried")
    yield found
    found.give_up()


def turn(node: AbstractNode, tick: int) -> Any:
    outputs = dict(node.step("r1", state_at(tick), {}))
    outputs.update(node.afterwards("r1"))
    return outputs.get(TAKEOVER)


def test_a_turn_with_a_bomb_takes_less_than_ten_milliseconds(
    apart: Apart, offer_of: Callable[..., ModelMessage]
) -> None:
    node = AdaptationNode(CAR)
    node.try_apart(lambda robot, offer: _hand_in(apart, node, OPTIONS, robot, offer))
    turn(node, 0)
    tick, spent = 1, []
    for change, document in enumerate(BOMBS.values(), 1):
        node.hear("r1", offer_of(document, change=change))
        answer, until = None, time.monotonic() + 30.0
        while answer is None and time.monotonic() < until:
            began = time.thread_time()
            answer = turn(node, tick)
            spent.append(time.thread_time() - began)
            tick += 1
            time.sleep(0.005)
        assert answer is not None, document[:40]
        assert (answer.state, answer.change) == ("refused", change)
    assert max(spent) < 0.010
    assert node.model_of("r1") == fingerprint(CAR)


def test_a_good_offer_is_taken_as_before(apart: Apart, offer_of: Callable[..., ModelMessage]) -> None:
    node = AdaptationNode(CAR)
    node.try_apart(lambda robot, offer: _hand_in(apart, node, OPTIONS, robot, offer))
    turn(node, 0)
    node.hear("r1", offer_of(DOCUMENT, NEW))
    for tick in range(1, 4000):
        answer = turn(node, tick)
        if answer is not None:
            break
        time.sleep(0.005)
    assert answer.state == "ready", answer.reason
    assert answer.fingerprint == NEW


@pytest.mark.parametrize("service", ["adaptation", "policy", "safety_filter"])
def test_each_service_tries_an_offer_as_it_would_take_it(service: str, offer_of: Callable[..., ModelMessage]) -> None:
    """Margins are the filter's business: without one it refuses, as in the loop."""
    work = (service, OPTIONS, "r1", offer_of(DOCUMENT, NEW), state_at(3), None)
    if service == "safety_filter":
        with pytest.raises(InputError, match="margin: got none"):
            tried(work)
    else:
        assert fingerprint(parse_model(tried(work)["document"])) == NEW


def test_a_model_that_takes_more_than_a_tick_has_is_refused(
    offer_of: Callable[..., ModelMessage], monkeypatch: pytest.MonkeyPatch
) -> None:
    step = AdaptationNode.step

    def slow(self: AdaptationNode, robot: str, state: StateMessage, inputs: Any) -> Any:
        until = time.process_time() + (0.02 if self.model_of(robot) == NEW else 0.0)
        while time.process_time() < until:
            continue
        return step(self, robot, state, inputs)

    monkeypatch.setattr(AdaptationNode, "step", slow)
    with pytest.raises(Exception, match=r"takes .* ms of the processor"):
        tried(("adaptation", OPTIONS, "r1", offer_of(DOCUMENT, NEW), state_at(3), None))


def test_a_car_with_every_effect_free_is_a_bounded_matter(offer_of: Callable[..., ModelMessage]) -> None:
    """More effects and free parameters than any library has are refused by their number."""
    document = write_model(CAR)
    for item in effects_of("car").values():
        document += f'\n[[effects]]\nname = "{item.name}"\n'
        document += "".join(f"{p.name} = {{ value = {p.start!r}, free = true }}\n" for p in item.parameters)
    assert len(document) < 65_536
    with pytest.raises(InputError):  # not of this fingerprint; what costs time was done before
        tried(("adaptation", OPTIONS, "r1", offer_of(document), state_at(3), None))


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


def tells_its_niceness(work: object) -> dict[str, Any]:
    return {"nice": os.nice(0), "policy": os.sched_getscheduler(0)}


@pytest.mark.parametrize(
    ("function", "words"),
    [("spins", "processor time"), ("eats", ""), ("dies", "ended its process"), ("writes", "")],
)
def test_what_takes_too_much_is_ended_and_the_next_work_is_done(function: str, words: str, tmp_path: Path) -> None:
    apart = _apart(function, tmp_path)
    try:
        began = time.monotonic()
        outcome = apart.hand_in(str(tmp_path / "file")).outcome(wait=True)
        assert outcome is not None
        assert words in outcome["problem"]
        assert outcome["problem"]
        assert time.monotonic() - began < 20.0
        assert not (tmp_path / "file").exists() or (tmp_path / "file").stat().st_size == 0
    finally:
        apart.give_up()


def test_it_runs_behind_everybody_else(tmp_path: Path) -> None:
    apart = _apart("tells_its_niceness", tmp_path)
    try:
        assert apart.hand_in(None).outcome(wait=True) == {"nice": 19, "policy": os.SCHED_OTHER}
    finally:
        apart.give_up()


def test_handing_in_never_waits_even_where_nobody_reads(tmp_path: Path) -> None:
    apart = _apart("spins", tmp_path)
    try:
        spent = []
        for _ in range(40):
            began = time.thread_time()
            apart.hand_in("x" * 65_536)
            spent.append(time.thread_time() - began)
        assert max(spent) < 0.010
    finally:
        apart.give_up()


def _apart(function: str, folder: Path) -> Apart:
    """With a function of this file, which the process finds as a module of its own."""
    source = Path(__file__).read_text(encoding="utf-8")
    begin, end = source.index("def spins"), source.index('@pytest.mark.parametrize(\n    ("function"')
    head = "import os\nfrom pathlib import Path\nfrom typing import Any\n\n\n"
    (folder / "works_apart.py").write_text(head + source[begin:end], encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(folder))
        return Apart(f"works_apart:{function}")


def test_a_repaired_version_needs_no_trial(offer_of: Callable[..., ModelMessage]) -> None:
    """What is in force already is not loaded again."""
    versions: ModelVersions[str] = ModelVersions("policy", "held", "0123456789ab", lambda robot, offer: "other")
    versions.hand_in = lambda robot, offer: pytest.fail("nothing is to be tried")
    versions.welcome("r1", Answer(ok=True, sentence="", fingerprint="0123456789ab"))
    versions.hear("r1", offer_of("document"))
    answer = versions.answer("r1", state_at(1))
    assert answer is not None
    assert answer.state == "ready"
