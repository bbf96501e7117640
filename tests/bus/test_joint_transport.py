"""Several services of one process over one session."""

from __future__ import annotations

import pytest

from safedpa.bus import MemoryBroker, MemoryTransport
from safedpa.bus.joint_transport import JointTransport
from safedpa.errors import BusError

INSIDE = frozenset(["latent"])


class Heard:
    def __init__(self) -> None:
        self.samples: list[tuple[str, bytes]] = []

    def __call__(self, key: str, payload: bytes) -> None:
        self.samples.append((key, payload))


def test_what_services_say_to_each_other_is_heard_inside_once_and_outside() -> None:
    broker = MemoryBroker()
    joint, outside = JointTransport(MemoryTransport(broker), INSIDE), Heard()
    MemoryTransport(broker).subscribe("safedpa/f/*/latent", outside)
    one, every, other = Heard(), Heard(), Heard()
    joint.subscribe("safedpa/f/r/latent", one)
    joint.subscribe("safedpa/f/*/latent", every)
    joint.subscribe("safedpa/f/q/latent", other)
    joint.put("safedpa/f/r/latent", b"x", never_drop=False)
    sample = ("safedpa/f/r/latent", b"x")
    assert [one.samples, every.samples, other.samples, outside.samples] == [[sample], [sample], [], [sample]]


def test_who_speaks_as_a_service_that_lives_here_is_not_heard() -> None:
    broker = MemoryBroker()
    joint, heard = JointTransport(MemoryTransport(broker), INSIDE), Heard()
    joint.subscribe("safedpa/f/*/latent", heard)
    joint.subscribe("safedpa/f/*/state", heard)
    stranger = MemoryTransport(broker)
    stranger.put("safedpa/f/r/latent", b"forged", never_drop=False)
    stranger.put("safedpa/f/r/state", b"state", never_drop=False)
    assert heard.samples == [("safedpa/f/r/state", b"state")]


def test_what_comes_under_odd_keys_does_no_harm() -> None:
    heard = Heard()
    hand_on = JointTransport(MemoryTransport(MemoryBroker()), INSIDE)._to_all([heard])
    for key in ("safedpa/**", "**", ""):  # Zenoh lets a sender use wildcards, and a subscriber sees them as they came
        hand_on(key, b"x")
    assert [key for key, _ in heard.samples] == ["safedpa/**", "**", ""]


def test_all_of_them_have_a_message_before_the_first_one_acts_on_it() -> None:
    broker = MemoryBroker()
    joint, order = JointTransport(MemoryTransport(broker), INSIDE), list[str]()
    for name in ("adaptation", "policy", "safety_filter"):
        joint.subscribe("safedpa/f/*/state", lambda _key, _payload, name=name: order.append(name))  # type: ignore[misc]
    MemoryTransport(broker).put("safedpa/f/r/state", b"x", never_drop=False)
    assert order == ["safety_filter", "policy", "adaptation"]


def test_everything_else_is_the_sessions() -> None:
    outer = MemoryTransport(MemoryBroker())
    joint = JointTransport(outer, INSIDE)
    joint.declare_alive("safedpa/f/-/alive/policy/1")
    joint.answer("safedpa/f/*/status", lambda _key, payload: payload + b"!")
    assert joint.alive("safedpa/f/-/alive/*/*") == ["safedpa/f/-/alive/policy/1"]
    assert joint.ask("safedpa/f/r/status", b"how", 1.0) == b"how!"
    answers: list[bytes | None] = []
    joint.ask_soon("safedpa/f/r/status", b"how", 1.0, answers.append)
    assert answers == [b"how!"]
    joint.close()
    with pytest.raises(BusError):
        joint.put("safedpa/f/r/latent", b"x", never_drop=False)
