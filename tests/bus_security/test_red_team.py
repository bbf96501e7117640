"""Attacks on a secured bus. Every one that is blocked has a twin that is delivered where no one guards."""

from collections.abc import Iterable
from functools import partial
from typing import Any

import pytest

from safedpa.adaptation import AdaptationNode
from safedpa.bus import ROSTER, STATE, TOPICS, AbstractNode, Bus, Topic, key_of, request_key
from safedpa.bus.messages.requests import AGREED, CONFIRM, LEASE, ORDER, REQUEST, SENSE, STATUS
from safedpa.bus.security.access_control import roles_of
from safedpa.errors import BusError
from safedpa.live.node import DiagnosisNode
from safedpa.perception.node import PerceptionNode
from safedpa.policy import PolicyNode
from safedpa.runtime.node import SafetyFilterNode

pytestmark = pytest.mark.processes

NODES: tuple[type[AbstractNode], ...] = (AdaptationNode, PerceptionNode, PolicyNode, SafetyFilterNode, DiagnosisNode)
LOOP = {"adaptation", "policy", "safety_filter"}
SILENT = {"operator", "healthcheck"}
OBSERVERS = {"recorder", "metrics", "dashboard", "workbench", "operator"}
ALL = tuple(TOPICS.values())


def roles(network: Any) -> list[str]:
    return [role for role in (*roles_of(network.robots), *network.strangers) if role != "router"]


def kind_of(role: str) -> str:
    return "robot" if role in ("robot.r1", "robot.r2") else role


def targets(network: Any) -> Iterable[tuple[Topic, str, str]]:
    """Every topic of every robot, and of none, under every service's name."""
    for topic in ALL:
        for robot in (*network.robots, "r3", "-"):
            services = sorted({*map(kind_of, roles(network)), "router"}) if topic.per_service else [""]
            yield from ((topic, robot, service) for service in services)


def may_write(network: Any, role: str, topic: Topic, robot: str, service: str) -> bool:
    """From the writer column, for robots that belong to the fleet."""
    kind = kind_of(role)
    own = {role.removeprefix("robot.")} if kind == "robot" else {*network.robots}
    if topic is ROSTER:  # about the whole fleet, never about one robot
        own = {"-"}
    if not topic.per_service:
        return kind == topic.writer and robot in own
    speaks = kind in LOOP if topic.name == "takeover" else role not in {*SILENT, *network.strangers}
    return speaks and service == kind and robot in ({*own} if kind == "robot" else {*own, "-"})


@pytest.mark.parametrize("guarded", [True, False], ids=["blocked", "delivered"])
def test_the_right_to_put_is_exactly_the_writer_column(network: Any, guarded: bool) -> None:
    network.start(guarded=guarded)
    ear = network.ear(network.raw("recorder"), *(key_of(network.fleet, "*", topic, "*") for topic in ALL))
    notice = {key_of(network.fleet, "r1", topic, "any") for topic in ALL}

    def listens() -> bool:  # to every topic: what attackers say, each once, is lost before that
        for key in notice - ear.keys:
            network.router.put(key, b"fence", never_drop=False)
        return notice <= ear.keys

    assert network.until(listens)
    expected = set()
    for role in roles(network):
        attacker = network.raw(role)
        for topic, robot, service in targets(network):
            key = key_of(network.fleet, robot, topic, service)
            attacker.put(key, role.encode())
            if not guarded or may_write(network, role, topic, robot, service):
                expected.add((role, key))
        network.leave(attacker)
    network.fence(ear)
    assert {(payload.decode(), key) for key, payload, _ in ear.heard if b"fence" not in payload} == expected


WILDCARDS = ("safedpa/f/*/action", "safedpa/f/r1/*", "safedpa/f/**", "safedpa/*/r1/action", "safedpa/**", "**")


@pytest.mark.parametrize("guarded", [True, False], ids=["blocked", "delivered"])
def test_no_role_puts_under_wildcards(network: Any, guarded: bool) -> None:
    network.start(guarded=guarded)
    ear = network.ear(network.raw("robot.r1"), "safedpa/f/r1/action")
    for role in roles(network):
        attacker = network.raw(role)
        for key in WILDCARDS:
            attacker.put(key, role.encode())
        network.leave(attacker)
    proof = network.raw("safety_filter")
    assert network.until(lambda: proof.put("safedpa/f/r1/action", b"proof") or ear.of(b"proof"))
    assert ear.keys == ({"safedpa/f/r1/action"} if guarded else {*WILDCARDS, "safedpa/f/r1/action"})


@pytest.mark.parametrize("guarded", [True, False], ids=["blocked", "delivered"])
def test_no_role_deletes_not_even_the_writer(network: Any, guarded: bool) -> None:
    network.start(guarded=guarded)
    ear = network.ear(network.raw("robot.r1"), "safedpa/f/r1/action")
    attacker = network.raw("safety_filter")

    def has_come() -> bool:  # both again and again: the first ones may leave before anybody is known to listen
        attacker.delete("safedpa/f/r1/action")
        attacker.put("safedpa/f/r1/action", b"proof")
        return bool(ear.of(b"proof")) and (guarded or "DELETE" in {kind for _, _, kind in ear.heard})

    assert network.until(has_come)
    assert ("DELETE" in {kind for _, _, kind in ear.heard}) is not guarded


def may_read(role: str, topic: Topic, robot: str) -> bool:
    """As the nodes declare what they need; a robot its own and what was decided of it, an observer everything."""
    kind = kind_of(role)
    if kind == "robot":
        return topic.name in ("state", "action", "verdict") and role == f"robot.{robot}"
    node = next((node for node in NODES if node.name == kind), None)
    if node is not None:
        return topic is STATE or topic in (*node.inputs, *node.sensor_inputs, *node.listens)
    return kind in OBSERVERS or (kind == "healthcheck" and topic.name == "health")


@pytest.mark.parametrize("guarded", [True, False], ids=["blocked", "delivered"])
def test_each_role_hears_exactly_what_it_needs(network: Any, guarded: bool) -> None:
    router = network.start(guarded=guarded)
    keys = {(topic, robot): key_of(network.fleet, robot, topic, "any") for topic in ALL for robot in network.robots}
    ears = {}
    for role in roles(network):
        session = network.raw(role)
        wanted = [key_of(network.fleet, robot, topic, "*") for topic, robot in keys]
        wanted += [key_of(network.fleet, "*", topic, "*") for topic in ALL] + ["safedpa/f/**", "**"]
        ears[role] = network.ear(session, *wanted)
    allowed = {
        role: {key for (topic, robot), key in keys.items() if not guarded or may_read(role, topic, robot)}
        for role in ears
    }

    def heard(role: str, word: str = "") -> set[str]:
        """Keys of messages that came, as they say themselves: after a lost link Zenoh may tell another one."""
        notice = (payload.decode().partition(" ") for _, payload, _ in list(ears[role].heard))
        return {key for own, _, key in notice if not word or own == word}

    def reported(word: str, role: str) -> bool:
        """Whether a role has received all that it may read; otherwise sends the missing messages again.

        Repeating all messages would fill the queue of a slow reader with the first keys, and the last ones would never
        arrive. Messages of the router's own session are not filtered.
        """
        missing = allowed[role] - heard(role, word)
        for key in missing:
            router.put(key, f"{word} {key}".encode(), never_drop=False)
        return not missing

    for word in ("first", "last"):  # once the last ones arrive, no message of the first round is in flight
        for role in ("recorder", *ears):  # it may hear everything
            assert network.until(lambda word=word, role=role: reported(word, role), every=0.05), role
    for role in ears:
        assert heard(role) == allowed[role], role


MAY_ASK = {
    REQUEST: {"operator", "workbench"},
    STATUS: {"operator", "workbench", *LOOP},
    ORDER: {"operator"},
    CONFIRM: {"robot.r1"},
    SENSE: {"operator"},
    AGREED: LOOP,
    LEASE: {"safety_filter"},
}


@pytest.mark.parametrize("guarded", [True, False], ids=["blocked", "delivered"])
def test_only_the_roles_of_the_table_may_ask(network: Any, guarded: bool) -> None:
    network.start(guarded=guarded)
    diagnosis, safety_filter = network.join("diagnosis"), network.join("safety_filter")
    perception = network.join("perception")
    asked: list[tuple[str, str]] = []

    def answer(key: str, payload: bytes) -> bytes:
        asked.append((payload.decode(), key.rsplit("/", 1)[1]))
        return b"yes"

    for kind, transport in (  # of each session that one last which is tried first: the router knows the others then
        (STATUS, diagnosis),
        (REQUEST, diagnosis),
        (AGREED, safety_filter),
        (ORDER, safety_filter),
        (CONFIRM, safety_filter),
        (SENSE, perception),
        (LEASE, network.router),
    ):
        transport.answer(request_key(network.fleet, "*", kind), answer)
    operator = network.join("operator")
    assert network.until(lambda: operator.ask(request_key("f", "r1", REQUEST), b"ready", 0.2) == b"yes")
    assert network.until(lambda: operator.ask(request_key("f", "r1", ORDER), b"ready", 0.2) == b"yes")
    assert network.until(lambda: operator.ask(request_key("f", "r1", SENSE), b"ready", 0.2) == b"yes")
    expected = {("ready", REQUEST), ("ready", ORDER), ("ready", SENSE)}
    for role in roles(network):
        attacker = network.join(role)
        for kind, allowed in MAY_ASK.items():
            ask = partial(attacker.ask, request_key("f", "r1", kind), role.encode())
            if role in allowed:
                assert network.until(lambda ask=ask: ask(1.0) == b"yes"), (role, kind)
            else:
                ask(0.02)
            if not guarded or role in allowed:
                expected.add((role, kind))
        network.leave(attacker)
    assert network.until(lambda: expected <= set(asked))
    assert set(asked) == expected


@pytest.mark.parametrize("guarded", [True, False], ids=["blocked", "delivered"])
def test_no_other_role_answers_for_the_diagnosis_or_the_filter(network: Any, guarded: bool) -> None:
    network.start(guarded=guarded)
    asked_of = {REQUEST: "diagnosis", ORDER: "safety_filter", SENSE: "perception"}
    lies = {(role, kind) for role in roles(network) for kind, honest in asked_of.items() if role != honest}
    heard: set[tuple[str, str]] = set()
    for lie in sorted(lies):
        network.join(lie[0]).answer(request_key("f", "*", lie[1]), lambda key, payload, lie=lie: heard.add(lie))
    operator = network.join("operator")

    def asked() -> bool:
        for kind in asked_of:
            operator.ask(request_key("f", "r1", kind), b"?", 0.2)
        return heard == lies

    if guarded:
        honest = network.join("diagnosis")
        honest.answer(request_key("f", "*", REQUEST), lambda key, payload: b"yes")
        assert network.until(lambda: operator.ask(request_key("f", "r1", REQUEST), b"?", 0.2) == b"yes")
        asked()
        assert heard == set()
    else:
        assert network.until(asked)


@pytest.mark.parametrize("guarded", [True, False], ids=["blocked", "delivered"])
def test_a_name_cannot_be_taken_from_a_robot_by_others(network: Any, guarded: bool) -> None:
    network.start(guarded=guarded)
    for role in roles(network):
        if role != "robot.r1":
            network.join(role).declare_alive("safedpa/f/r1/alive/robot/0")
    robot = Bus(network.join("robot.r1"), network.fleet)
    if guarded:
        robot.claim("r1", "robot", "m")
        assert network.until(lambda: robot.instances("r1", "robot") == ["m"])
    else:
        assert network.until(lambda: robot.instances("r1", "robot") == ["0"])
        with pytest.raises(BusError, match="is already running"):
            robot.claim("r1", "robot", "m")


@pytest.mark.parametrize("guarded", [True, False], ids=["blocked", "delivered"])
@pytest.mark.parametrize("role", ["intruder", "policy", "robot.r2"])
def test_joining_as_a_router_gives_no_role_more_rights(network: Any, role: str, guarded: bool) -> None:
    network.start(guarded=guarded)
    ear = network.ear(network.raw("robot.r1"), "safedpa/f/r1/action")
    attacker = network.raw(role, mode="router")
    attacker.put("safedpa/f/r1/action", b"evil")
    if guarded:
        network.leave(attacker)
        proof = network.raw("safety_filter")
        assert network.until(lambda: proof.put("safedpa/f/r1/action", b"proof") or ear.of(b"proof"))
    else:
        assert network.until(lambda: attacker.put("safedpa/f/r1/action", b"evil") or ear.heard)
    assert (b"evil" in {payload for _, payload, _ in ear.heard}) is not guarded


@pytest.mark.parametrize("guarded", [True, pytest.param(False, marks=pytest.mark.long)], ids=["blocked", "delivered"])
def test_what_is_larger_than_its_topic_allows_stops_at_the_router(network: Any, guarded: bool) -> None:
    """All three again and again: the first ones may leave before anybody is known to listen."""
    network.start(guarded=guarded)
    ear = network.ear(network.raw("recorder"), "safedpa/f/r1/action", "safedpa/f/r1/finding")
    for role, topic in (("safety_filter", TOPICS["action"]), ("diagnosis", TOPICS["finding"])):
        sender, key = network.join(role), key_of("f", "r1", topic)
        sizes = (topic.largest_bytes, topic.largest_bytes + 1, 1)
        wanted = [size for size in sizes if not guarded or size <= topic.largest_bytes]

        def turn(sender: Any = sender, key: str = key, sizes: Any = sizes, wanted: Any = wanted) -> bool:
            """Whether the latest that came are one whole turn, as far as it may come."""
            for size in sizes:
                sender.put(key, bytes(size), never_drop=True)
            heard = [len(payload) for under, payload, _ in list(ear.heard) if under == key]
            return heard[-len(wanted) :] == wanted

        assert network.until(turn, every=0.2)
        heard = {len(payload) for under, payload, _ in ear.heard if under == key}
        assert heard == set(wanted)
