"""Two routers, robots on one and services on the other: access control holds across the link, for what it can."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest

from safedpa.bus import Bus, ZenohSettings, ZenohTransport, request_key
from safedpa.bus.security.access import access_control
from safedpa.bus.transport.ports import free_port
from safedpa.bus.wire.requests import REQUEST
from safedpa.errors import InputError

pytestmark = pytest.mark.processes

Join = Callable[..., ZenohTransport]


@pytest.fixture
def west(network: Any) -> Iterator[Callable[..., Join]]:
    """Starts a second router that links itself to the first one; returns how to join it."""
    endpoint = network.endpoint.rsplit(":", 1)[0] + f":{free_port()}"

    def started(role: str = "router.west", *, guarded: bool = True) -> Join:
        access = access_control(network.fleet, network.robots) if guarded else None
        long: Any = {"patience": network.patience}
        settings = ZenohSettings("router", (endpoint,), (network.endpoint,), network.card(role), access, **long)
        started.router = network.opened(settings)  # type: ignore[attr-defined]
        return lambda name: network.opened(ZenohSettings("client", (), (endpoint,), network.card(name), **long))

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


def arrives(network: Any, sender: ZenohTransport, key: str, payload: bytes, ear: Any) -> bool:
    return bool(network.until(lambda: sender._session.put(key, payload) or ear.of(payload)))


def test_the_loop_closes_across_the_link_and_intruders_are_blocked_on_both_sides(network: Any, west: Any) -> None:
    east(network, {"router.west": ()})
    join_west = west()
    robot, filtering = network.join("robot.r1"), join_west("safety_filter")
    hears_state = network.ear(filtering, "safedpa/f/*/state")
    hears_action = network.ear(robot, "safedpa/f/r1/action")
    assert arrives(network, robot, "safedpa/f/r1/state", b"state", hears_state)
    for role in ("policy", "intruder", "robot.r2"):
        for attacker in (join_west(role), network.join(role)):
            attacker._session.put("safedpa/f/r1/action", b"evil")
            attacker._session.put("safedpa/f/r1/state", b"evil")
            attacker.close()
    assert arrives(network, filtering, "safedpa/f/r1/action", b"action", hears_action)
    assert arrives(network, robot, "safedpa/f/r1/state", b"last", hears_state)
    assert {payload for _, payload, _ in hears_action.heard} == {b"action"}
    assert {payload for _, payload, _ in hears_state.heard} == {b"state", b"last"}


def test_questions_and_signs_of_life_cross_the_link(network: Any, west: Any) -> None:
    east(network, {"router.west": ()})
    join_west = west()
    join_west("diagnosis").answer(request_key("f", "*", REQUEST), lambda key, payload: b"yes")
    operator = network.join("operator")
    assert network.until(lambda: operator.ask(request_key("f", "r1", REQUEST), b"?", 0.2) == b"yes")
    Bus(join_west("robot.r2"), "f").announce("r2", "robot", "i")
    assert network.until(lambda: Bus(operator, "f").instances("r2", "robot") == ["i"])


@pytest.mark.parametrize("guarded", [True, False], ids=["blocked", "delivered"])
def test_a_router_that_does_not_guard_its_clients_harms_only_its_own_robots(
    network: Any, west: Any, guarded: bool
) -> None:
    """A region's router was taken over; the others let it bring messages of its own robots alone."""
    east(network, {"router.west": ("r2",)} if guarded else {"router.west": ()})
    join_west = west(guarded=False)
    attacker = join_west("intruder")
    of_the_west = network.ear(network.join("robot.r2"), "safedpa/f/r2/action")
    of_the_east = network.ear(network.join("robot.r1"), "safedpa/f/r1/action")
    assert arrives(network, attacker, "safedpa/f/r2/action", b"evil", of_the_west)
    if guarded:
        attacker._session.put("safedpa/f/r1/action", b"evil")
        assert arrives(network, attacker, "safedpa/f/r2/action", b"fence", of_the_west)
        assert arrives(network, network.join("safety_filter"), "safedpa/f/r1/action", b"proof", of_the_east)
        assert {payload for _, payload, _ in of_the_east.heard} == {b"proof"}
    else:
        assert arrives(network, attacker, "safedpa/f/r1/action", b"evil", of_the_east)


def test_a_router_that_was_not_named_brings_nothing(network: Any, west: Any) -> None:
    east(network, {})
    join_west = west()
    ear = network.ear(network.join("robot.r1"), "safedpa/f/r1/action")
    stranded = join_west("safety_filter")
    stranded._session.put("safedpa/f/r1/action", b"stranded")
    network.leave(west.router)
    assert arrives(network, network.join("safety_filter"), "safedpa/f/r1/action", b"proof", ear)
    assert {payload for _, payload, _ in ear.heard} == {b"proof"}


@pytest.mark.parametrize(
    "links", [{"policy": ()}, {"router": ()}, {"router.west": ("*",)}, {"router.west": ("r1", "")}]
)
def test_only_routers_are_linked(links: dict[str, tuple[str, ...]]) -> None:
    with pytest.raises(InputError):
        access_control("f", ["r1"], links)
