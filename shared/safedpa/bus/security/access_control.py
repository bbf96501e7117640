"""Access control of the bus: the table of roles, and the router's configuration derived from it.

A role is the common name of a certificate. Only the writer of a topic may publish it, and only for the fleet's own
robots. Topics of every service may be published under the service's own name only. Everything else is denied, in both
directions: the router does not send a topic to a client without the right to read it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from safedpa.bus.messages.requests import AGREED, CONFIRM, LEASE, ORDER, REQUEST, SENSE, STATUS, request_key
from safedpa.bus.messages.topics import (
    ACTION,
    BUNDLE,
    HEALTH,
    LATENT,
    MODEL,
    NO_ROBOT,
    NOMINAL,
    ROSTER,
    SCAN,
    STAMP_BYTES,
    STATE,
    SURROUNDINGS,
    TAKEOVER,
    TOPICS,
    VERDICT,
    Topic,
    key_of,
)
from safedpa.errors import InputError

ROBOT = "robot"
ROUTER = "router"
# Hz per key. Robots tick at 500 Hz at most, in lockstep as fast as they are answered. Zenoh drops every message within
# 1/4000 s of the previous one under its key. That may affect a legitimate message that a busy machine delayed by a
# whole period and released together with the next one; the later of the two is lost then, and the robot brakes for one
# more period. A lower rate would make this more likely.
_MOST_RATE = 4000.0
# Hz of heartbeats per key. There are four a second, and one at each change of state.
_MOST_HEARTBEATS = 100.0
_IN, _OUT = "ingress", "egress"
# All message types of Zenoh's access control except "delete", which no role may send.
_DATA = ("put", "query", "reply", "liveliness_token")
_DECLARATIONS = ("declare_subscriber", "declare_queryable", "liveliness_query", "declare_liveliness_subscriber")
_EVERYTHING = tuple(TOPICS.values())


@dataclass(frozen=True)
class Role:
    """Rights of a kind of process, besides publishing the topics that it writes."""

    name: str
    reads: tuple[Topic, ...]
    """Topics that it may read, of every robot; a robot reads only its own."""
    asks: tuple[str, ...] = ()
    """Kinds of requests that it may send."""
    answers: tuple[str, ...] = ()
    """Kinds of requests that it answers."""
    lives: bool = True
    """Whether it declares itself alive and sends heartbeats."""
    looks: bool = False
    """Whether it may ask which processes are alive."""
    takes_over: bool = False
    """Whether it has models, which may change while it runs."""


ROLES: dict[str, Role] = {
    role.name: role
    for role in (
        # A robot reads its own state to notice another robot under its name.
        Role(ROBOT, (STATE, ACTION, VERDICT), asks=(CONFIRM,), looks=True),
        Role("adaptation", (STATE, MODEL), (STATUS, AGREED), (AGREED,), takes_over=True),
        Role("perception", (STATE, SCAN), answers=(SENSE,)),
        Role("policy", (STATE, SURROUNDINGS, LATENT, MODEL), (STATUS, AGREED), (AGREED,), takes_over=True),
        Role(
            "safety_filter",
            (STATE, SURROUNDINGS, LATENT, NOMINAL, MODEL),
            (STATUS, AGREED, LEASE),
            (AGREED, ORDER, CONFIRM),
            takes_over=True,
        ),
        Role("diagnosis", (STATE, LATENT, VERDICT, HEALTH, TAKEOVER), answers=(REQUEST, STATUS)),
        Role("recorder", _EVERYTHING),
        Role("metrics", _EVERYTHING),
        Role("dashboard", _EVERYTHING, looks=True),
        # A web page may change models, but only the operator's certificate may stop robots or switch sensors.
        Role("workbench", _EVERYTHING, asks=(REQUEST, STATUS), looks=True),
        Role("operator", _EVERYTHING, asks=(REQUEST, STATUS, ORDER, SENSE), lives=False, looks=True),
        Role("healthcheck", (HEALTH,), lives=False, looks=True),
    )
}
"""Every role but the router's own, by name."""


_Right = tuple[str, tuple[str, ...], str, tuple[str, ...]]
"""A right in Zenoh's terms: its name, the types of messages that may flow, ``ingress`` from the client to the router or
``egress`` to the client, and the keys."""


def role_of_robot(name: str) -> str:
    """Returns the common name of a robot's certificate."""
    return f"{ROBOT}.{name}"


def roles_of(robots: Iterable[str]) -> tuple[str, ...]:
    """Returns all roles of a fleet including the router's: one certificate each."""
    return (*map(role_of_robot, robots), *(name for name in ROLES if name != ROBOT), ROUTER)


def check_names(fleet: str, robots: tuple[str, ...]) -> None:
    """Raises InputError unless these are valid names of one fleet and of different robots."""
    for name in (fleet, *robots):
        key_of(name, name, STATE)  # raises for characters that are not valid in a key
        # With such a name, the rules of one robot would match others.
        if name in ("*", NO_ROBOT, BUNDLE):
            raise InputError(f"name '{name}': it is a placeholder for several robots or none, wanted one robot")
    if len(set(robots)) < len(robots):
        raise InputError(f"--robot: got {', '.join(robots)}, wanted every robot once")


def access_control(
    fleet: str, robots: Iterable[str], links: Mapping[str, tuple[str, ...]] = MappingProxyType({})
) -> dict[str, Any]:
    """Returns Zenoh's ``access_control`` for the router of a fleet with these robots.

    ``links`` has the routers that may be linked to this one: common name of the certificate, and the robots whose
    messages it may forward (an empty tuple: all robots). A router with the same name as this one may forward all.

    Raises InputError for invalid names and for a robot named twice.
    """
    names = tuple(robots)
    check_names(fleet, names)
    rules: list[dict[str, Any]] = []
    policies = []
    for subject, rights in (*_subjects(fleet, names), *_links(fleet, links)):
        own = [_rule(subject, right) for right in rights if right[3]]
        rules += own
        policies.append({"rules": [rule["id"] for rule in own], "subjects": [subject]})
    return {
        "enabled": True,  # without this key, Zenoh 1.10 permits everything, without a warning
        "default_permission": "deny",
        "rules": [*rules, _rule("", _NOTHING)],
        "subjects": [
            *({"id": name, "cert_common_names": [name]} for name in (*roles_of(names), *links)),
            {"id": _EVERYBODY, "link_protocols": ["tls"]},
        ],
        "policies": [*policies, {"rules": [_EVERYBODY], "subjects": [_EVERYBODY]}],
    }


_EVERYBODY = "everybody"
# A rule for a key that does not exist, granted to every TLS client. Zenoh's log names the client of a denied message
# only if at least one rule applies to that client.
_NOTHING: _Right = (_EVERYBODY, ("query",), _IN, ("safedpa/-/-/nothing",))


def _subjects(fleet: str, robots: tuple[str, ...]) -> Iterable[tuple[str, list[_Right]]]:
    for robot in robots:
        yield role_of_robot(robot), _rights(ROLES[ROBOT], fleet, (robot,), robot)
    for role in ROLES.values():
        if role.name != ROBOT:
            yield role.name, _rights(role, fleet, (*robots, BUNDLE, NO_ROBOT), "*")


def _links(fleet: str, links: Mapping[str, tuple[str, ...]]) -> Iterable[tuple[str, list[_Right]]]:
    yield ROUTER, _rights_of_a_router(fleet, ())
    for name, robots in links.items():
        check_names(fleet, robots)
        if not name.startswith(f"{ROUTER}."):
            raise InputError(f"--link {name}: wanted the name of a router's certificate, {ROUTER}.NAME")
        yield name, _rights_of_a_router(fleet, robots)


def _rule(subject: str, right: _Right) -> dict[str, Any]:
    what, messages, flow, keys = right
    content = {"messages": list(messages), "flows": [flow], "key_exprs": list(keys)}
    return {"id": f"{subject} {what}".strip(), "permission": "allow", **content}


def _rights(role: Role, fleet: str, writes_for: tuple[str, ...], reads_of: str) -> list[_Right]:
    """Returns the rights of a role that writes for some robots and reads of one robot, or with ``*`` of all."""
    puts = tuple(
        key_of(fleet, robot, topic, role.name)
        for topic in TOPICS.values()
        for robot in writes_for
        if may_write(role, topic, robot)
    )
    # A Zenoh publisher sends nothing until it has learned of a subscriber, so a writer must see the declarations of its
    # readers. Access control compares key expressions, and readers subscribe with wildcards.
    written = tuple(
        key_of(fleet, "*", topic, "*")
        for topic in TOPICS.values()
        if any(may_write(role, topic, robot) for robot in writes_for)
    )
    reads = tuple(key_of(fleet, reads_of, topic, "*") for topic in role.reads)
    asks = tuple(request_key(fleet, reads_of, kind) for kind in role.asks)
    answers = tuple(request_key(fleet, reads_of, kind) for kind in role.answers)
    lives = (_alive(fleet, writes_for[-1], role.name),) if role.lives else ()
    looks = (_alive(fleet, reads_of, role.name if reads_of != "*" else "*"),) if role.looks else ()
    return [
        ("puts", ("put",), _IN, puts),
        ("learns who reads", ("declare_subscriber",), _OUT, written),
        ("subscribes", ("declare_subscriber",), _IN, reads),
        ("reads", ("put",), _OUT, reads),
        ("asks", ("query",), _IN, asks),
        ("is answered", ("reply", "declare_queryable"), _OUT, asks),
        ("answers", ("reply", "declare_queryable"), _IN, answers),
        ("is asked", ("query",), _OUT, answers),
        ("lives", ("liveliness_token",), _IN, lives),
        ("looks", ("liveliness_query", "declare_liveliness_subscriber"), _IN, looks),
        ("sees", ("liveliness_token",), _OUT, looks),
    ]


def may_write(role: Role, topic: Topic, robot: str = "") -> bool:
    """Whether a role writes a topic about a robot.

    The robot ``-`` means a service of the whole fleet, ``+`` a bundle of messages about many robots.
    """
    if robot == BUNDLE and not topic.bundles:
        return False
    if topic is ROSTER:  # about the whole fleet, never about one robot
        return role.name == topic.writer and robot in ("", NO_ROBOT)
    if not topic.per_service:
        return role.name == topic.writer and robot != NO_ROBOT
    return role.takes_over if topic is TAKEOVER else role.lives


def _alive(fleet: str, robot: str, service: str) -> str:
    return f"safedpa/{fleet}/{robot}/alive/{service}/*"


def _rights_of_a_router(fleet: str, robots: tuple[str, ...]) -> list[_Right]:
    """Returns the rights of another router of the same fleet, which enforces the rights of its own clients.

    With ``robots`` it may forward the messages of these robots only, but still all declarations of its clients.
    """
    everything = (f"safedpa/{fleet}/**",)
    brings = tuple(f"safedpa/{fleet}/{robot}/**" for robot in (*robots, NO_ROBOT)) if robots else everything
    return [
        ("brings", _DATA, _IN, brings),
        ("wants", _DECLARATIONS, _IN, everything),
        ("takes away", (*_DATA, *_DECLARATIONS), _OUT, everything),
    ]


def rate_limits(fleet: str, robots: Iterable[str]) -> list[dict[str, Any]]:
    """Returns Zenoh's ``downsampling``: the maximum rate of messages per client and key; the router drops the rest.

    Applies to topics with one message per tick, for each robot and for bundles, and to heartbeats.
    """
    names = tuple(robots)
    ticking = [topic for topic in TOPICS.values() if topic.delivery == "latest" and not topic.per_service]
    rules = [{"key_expr": key_of(fleet, robot, topic), "freq": _MOST_RATE} for topic in ticking for robot in names]
    rules += [{"key_expr": key_of(fleet, BUNDLE, topic), "freq": _MOST_RATE} for topic in ticking if topic.bundles]
    # Exact keys instead of wildcards: Zenoh counts per rule, so all robots under a wildcard would share one limit.
    lives = [role.name for role in ROLES.values() if role.lives] + [ROUTER]
    rules += [
        {"key_expr": key_of(fleet, robot, HEALTH, service), "freq": _MOST_HEARTBEATS}
        for robot in (*names, NO_ROBOT, BUNDLE)
        for service in lives
    ]
    return [{"id": "rates", "flows": [_IN], "messages": ["put"], "rules": rules}] if names else []


def size_limits(fleet: str) -> list[dict[str, Any]]:
    """Returns Zenoh's ``low_pass_filter``: the router drops messages above the size limit of their topic."""
    by_size: dict[int, list[str]] = {}
    for topic in TOPICS.values():
        by_size.setdefault(topic.largest_bytes, []).append(key_of(fleet, "*", topic, "*"))
    return [
        {
            "id": f"at most {size} bytes",
            "flows": [_IN],
            "messages": ["put"],
            "key_exprs": keys,
            "size_limit": size + STAMP_BYTES,  # Zenoh counts the attachment, too
        }
        for size, keys in by_size.items()
    ]
