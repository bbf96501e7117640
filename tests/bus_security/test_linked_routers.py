"""Two routers, robots on one and services on the other: access control holds across the link, for what it can."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import pytest

from safedpa.bus import Bus, ZenohSettings, ZenohTransport, request_key
from safedpa.bus.messages.requests import REQUEST
from safedpa.bus.security.access_control import access_control
from safedpa.bus.transport.ports import free_port

pytestmark = pytest.mark.processes


@dataclass
class West:
    """The second router, and how to join it."""

    router: ZenohTransport
    join: Callable[[str], ZenohTransport]
    raw: Callable[[str], Any]


@pytest.fixture
def west(network: Any) -> Callable[..., West]:
    """Starts a second router that links itself to the first one."""
    endpoint = network.endpoint.rsplit(":", 1)[0] + f":{free_port()}"

    def started(role: str = "router.west", *, guarded: bool = True) -> West:
        access = access_control(network.fleet, network.robots) if guarded else None
        settings = ZenohSettings(
            "router", (endpoint,), (network.endpoint,), network.card(role), access, connect_timeout=network.patience
        )
        router = network.opened(settings)
        return West(router, partial(network.join, endpoint=endpoint), partial(network.raw, endpoint=endpoint))

    return started


def east(network: Any, links: dict[str, tuple[str, ...]]) -> None:
    network.router = network.opened(
        ZenohSettings(
            "router",
            (network.endpoint,),
            (),
            network.card("router"),
            access_control(network.fleet, network.robots, links),
        )
    )


def arrives(network: Any, sender: Any, key: str, payload: bytes, ear: Any) -> bool:
    return bool(network.until(lambda: sender.put(key, payload) or ear.of(payload)))


def test_the_loop_closes_across_the_link_and_intruders_are_blocked_on_both_sides(network: Any, west: Any) -> None:
    east(network, {"router.west": ()})
    western = west()
    robot, filtering = network.raw("robot.r1"), western.raw("safety_filter")
    hears_state = network.ear(filtering, "safedpa/f/*/state")
    hears_action = network.ear(robot, "safedpa/f/r1/action")
    assert arrives(network, robot, "safedpa/f/r1/state", b"state", hears_state)
    for role in ("policy", "intruder", "robot.r2"):
        for attacker in (western.raw(role), network.raw(role)):
            attacker.put("safedpa/f/r1/action", b"evil")
            attacker.put("safedpa/f/r1/state", b"evil")
            attacker.close()
    assert arrives(network, filtering, "safedpa/f/r1/action", b"action", hears_action)
    assert arrives(network, robot, "safedpa/f/r1/state", b"last", hears_state)
    assert {payload for _, payload, _ in hears_action.heard} == {b"action"}
    assert {payload for _, payload, _ in hears_state.heard} == {b"state", b"last"}


def test_questions_and_signs_of_life_cross_the_link(network: Any, west: Any) -> None:
    east(network, {"router.west": ()})
    western = west()
    western.join("diagnosis").answer(request_key("f", "*", REQUEST), lambda key, payload: b"yes")
    operator = network.join("operator")
    assert network.until(lambda: operator.ask(request_key("f", "r1", REQUEST), b"?", 0.2) == b"yes")
    Bus(western.join("robot.r2"), "f").announce("r2", "robot", "i")
    assert network.until(lambda: Bus(operator, "f").instances("r2", "robot") == ["i"])


@pytest.mark.parametrize("guarded", [True, False], ids=["blocked", "delivered"])
def test_a_router_that_does_not_guard_its_clients_harms_only_its_own_robots(network: Any, west: Any, guarded: bool):
    """A region's router was taken over; the others let it bring messages of its own robots alone."""
    east(network, {"router.west": ("r2",)} if guarded else {"router.west": ()})
    attacker = west(guarded=False).raw("intruder")
    of_the_west = network.ear(network.raw("robot.r2"), "safedpa/f/r2/action")
    of_the_east = network.ear(network.raw("robot.r1"), "safedpa/f/r1/action")
    assert arrives(network, attacker, "safedpa/f/r2/action", b"evil", of_the_west)
    if guarded:
        attacker.put("safedpa/f/r1/action", b"evil")
        assert arrives(network, attacker, "safedpa/f/r2/action", b"fence", of_the_west)
        assert arrives(network, network.raw("safety_filter"), "safedpa/f/r1/action", b"proof", of_the_east)
        assert {payload for _, payload, _ in of_the_east.heard} == {b"proof"}
    else:
        assert arrives(network, attacker, "safedpa/f/r1/action", b"evil", of_the_east)


def test_a_router_that_was_not_named_brings_nothing(network: Any, west: Any) -> None:
    east(network, {})
    western = west()
    ear = network.ear(network.raw("robot.r1"), "safedpa/f/r1/action")
    stranded = western.raw("safety_filter")
    stranded.put("safedpa/f/r1/action", b"stranded")
    network.leave(western.router)
    assert arrives(network, network.raw("safety_filter"), "safedpa/f/r1/action", b"proof", ear)
    assert {payload for _, payload, _ in ear.heard} == {b"proof"}
