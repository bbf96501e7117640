"""Offered models cost the loop nothing, whatever they hold: they are tried in a process of their own."""

import argparse
import math
import time
from collections.abc import Callable, Iterator
from itertools import count
from typing import Any

import pytest
from tests.safety.node_steps import state_at

from safedpa.adaptation import AdaptationNode
from safedpa.bus import TAKEOVER, AbstractNode, ModelMessage, StateMessage
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


@pytest.fixture
def apart() -> Iterator[JobProcess]:
    found = JobProcess("safedpa_services.model_trial:run_model_trial", lambda: time.monotonic() / _BEHIND_OTHERS)
    yield found
    found.close()


def turn(node: AbstractNode, tick: int) -> Any:
    outputs = dict(node.step("r1", state_at(tick, lockstep=False), {}))
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
