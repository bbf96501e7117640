"""Who may do what on the bus: one table of roles, and from it and the table of topics the router's access control.

A role is the common name of a certificate. Who may put under a topic is that topic's writer, under the names of the
fleet's own robots and no one else's; health and takeover are put under the own service name only. What no line
allows is denied, in both directions: anyone who may not read a topic is sent nothing of it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from safedpa.bus.messages.key_stamp import STAMP_BYTES
from safedpa.bus.messages.requests import AGREED, ORDER, REQUEST, SENSE, STATUS, request_key
from safedpa.bus.messages.topics import (
    ACTION,
    BUNDLE,
    HEALTH,
    LATENT,
    MODEL,
    NOMINAL,
    SCAN,
    STATE,
    SURROUNDINGS,
    TAKEOVER,
    TOPICS,
    VERDICT,
    Topic,
    key_of,
)
from safedpa.errors import InputError

__all__ = [
    "NO_ONE",
    "ROBOT",
    "ROLES",
    "ROUTER",
    "Role",
    "access_control",
    "check_names",
    "may_write",
    "rate_limits",
    "role_of_robot",
    "roles_of",
    "size_limits",
]

NO_ONE = "-"
"""Stands for the robot in the keys of a service that serves the whole fleet."""
ROBOT = "robot"
ROUTER = "router"
_MOST_RATE = 4000.0
"""Hz under one key. Robots tick at 500 at most, in lockstep as fast as they are answered. Zenoh passes over whatever
follows within a quarter of a millisecond, also an honest message that a busy machine held up for a whole period and let
go together with the next one of its key: then the later of the two is lost, and its robot brakes for one period more.
"""
_MOST_BEATS = 100.0
"""Hz of heartbeats under one key, of which there are four a second, and another when a state changes."""
_IN, _OUT = "ingress", "egress"
_CARRIED = ("put", "query", "reply", "liveliness_token")
_WANTED = ("declare_subscriber", "declare_queryable", "liveliness_query", "declare_liveliness_subscriber")
"""Together all but delete, which no one may."""
_EVERYTHING = tuple(TOPICS.values())


@dataclass(frozen=True)
class Role:
    """What a kind of process does on the bus besides writing the topics whose writer it is."""

    name: str
    reads: tuple[Topic, ...]
    """Topics; of every robot, but a robot those of its own alone."""
    asks: tuple[str, ...] = ()
    """Kinds of questions."""
    answers: tuple[str, ...] = ()
    lives: bool = True
    """Whether it announces itself and sends heartbeats."""
    looks: bool = False
    """Whether it may ask who lives."""
    takes_over: bool = False
    """Whether it holds models, which change while it runs."""


ROLES: dict[str, Role] = {
    role.name: role
    for role in (
        Role(ROBOT, (STATE, ACTION, VERDICT), looks=True),
        Role("adaptation", (STATE, MODEL), (STATUS, AGREED), (AGREED,), takes_over=True),
        Role("perception", (STATE, SCAN), answers=(SENSE,)),
        Role("policy", (STATE, SURROUNDINGS, LATENT, MODEL), (STATUS, AGREED), (AGREED,), takes_over=True),
        Role(
            "safety_filter",
            (STATE, SURROUNDINGS, LATENT, NOMINAL, MODEL),
            (STATUS, AGREED),
            (AGREED, ORDER),
            takes_over=True,
        ),
        Role("diagnosis", (STATE, LATENT, VERDICT, HEALTH, TAKEOVER), answers=(REQUEST, STATUS)),
        Role("recorder", _EVERYTHING),
        Role("metrics", _EVERYTHING),
        Role("dashboard", _EVERYTHING, looks=True),
        Role("workbench", _EVERYTHING, asks=(REQUEST, STATUS), looks=True),
        Role("operator", _EVERYTHING, asks=(REQUEST, STATUS, ORDER, SENSE), lives=False, looks=True),
        Role("healthcheck", (HEALTH,), lives=False, looks=True),
    )
}
"""Every role but the router's own; a robot reads its own topics alone."""


@dataclass(frozen=True)
class _AccessRule:
    """One kind of right of one role, as Zenoh names it: messages that may flow one way under keys."""

    what: str
    messages: tuple[str, ...]
    flow: str
    """``ingress``: what the router takes from it; ``egress``: what the router sends to it."""
    keys: tuple[str, ...]


def role_of_robot(name: str) -> str:
    """Common name of a robot's certificate."""
    return f"{ROBOT}.{name}"


def roles_of(robots: Iterable[str]) -> tuple[str, ...]:
    """Every role of a fleet, the router's among them: whose certificates there are."""
    return (*map(role_of_robot, robots), *(name for name in ROLES if name != ROBOT), ROUTER)


def check_names(fleet: str, robots: tuple[str, ...]) -> None:
    """Raises InputError unless these can be the names of one fleet and of different robots, each of one robot."""
    for name in (fleet, *robots):
        key_of(name, name, STATE)
        if name in ("*", NO_ONE, BUNDLE):
            raise InputError(f"name '{name}': stands for every robot, none or many, wanted one")
    if len(set(robots)) < len(robots):
        raise InputError(f"--robot: got {', '.join(robots)}, wanted every robot once")


def access_control(
    fleet: str, robots: Iterable[str], links: Mapping[str, tuple[str, ...]] = MappingProxyType({})
) -> dict[str, Any]:
    """Zenoh's ``access_control`` for the router of a fleet with these robots.

    ``links`` names further routers that may be linked to this one, by the common names of their certificates, each with
    the robots of which it may bring messages; none: all. One that shows the same name as this one may bring all.

    Raises InputError for names that the bus cannot carry, or a robot named twice.
    """
    names = tuple(robots)
    check_names(fleet, names)
    rules: list[dict[str, Any]] = []
    policies = []
    for subject, rights in (*_subjects(fleet, names), *_links(fleet, links)):
        own = [_rule(f"{subject} {right.what}", right) for right in rights if right.keys]
        rules += own
        policies.append({"rules": [rule["id"] for rule in own], "subjects": [subject]})
    return {
        "enabled": True,  # left out, everything is allowed, and Zenoh says nothing
        "default_permission": "deny",
        "rules": [*rules, _rule(_EVERYBODY, _NOTHING)],
        "subjects": [
            *({"id": name, "cert_common_names": [name]} for name in (*roles_of(names), *links)),
            {"id": _EVERYBODY, "link_protocols": ["tls"]},
        ],
        "policies": [*policies, {"rules": [_EVERYBODY], "subjects": [_EVERYBODY]}],
    }


_EVERYBODY = "everybody"
_NOTHING = _AccessRule("", ("query",), _IN, ("safedpa/-/-/nothing",))
"""A right to nothing, since Zenoh does not name in its log those who have no rights at all."""


def _subjects(fleet: str, robots: tuple[str, ...]) -> Iterable[tuple[str, list[_AccessRule]]]:
    for robot in robots:
        yield role_of_robot(robot), _rights(ROLES[ROBOT], fleet, (robot,), robot)
    for role in ROLES.values():
        if role.name != ROBOT:
            yield role.name, _rights(role, fleet, (*robots, BUNDLE, NO_ONE), "*")


def _links(fleet: str, links: Mapping[str, tuple[str, ...]]) -> Iterable[tuple[str, list[_AccessRule]]]:
    yield ROUTER, _rights_of_a_router(fleet, ())
    for name, robots in links.items():
        check_names(fleet, robots)
        if not name.startswith(f"{ROUTER}."):
            raise InputError(f"--link {name}: wanted the name of a router's certificate, {ROUTER}.NAME")
        yield name, _rights_of_a_router(fleet, robots)


def _rule(name: str, right: _AccessRule) -> dict[str, Any]:
    return {
        "id": name,
        "permission": "allow",
        "messages": list(right.messages),
        "flows": [right.flow],
        "key_exprs": list(right.keys),
    }


def _rights(role: Role, fleet: str, writes_for: tuple[str, ...], reads_of: str) -> list[_AccessRule]:
    """Of one role that writes for some robots and reads of one, or with ``*`` of all."""
    puts = tuple(
        key_of(fleet, robot, topic, role.name)
        for topic in TOPICS.values()
        for robot in writes_for
        if may_write(role, topic, robot)
    )
    written = tuple(
        key_of(fleet, "*", topic, "*")  # as readers subscribe to it: a publisher who hears of no reader sends nothing
        for topic in TOPICS.values()
        if any(may_write(role, topic, robot) for robot in writes_for)
    )
    reads = tuple(key_of(fleet, reads_of, topic, "*") for topic in role.reads)
    asks = tuple(request_key(fleet, reads_of, kind) for kind in role.asks)
    answers = tuple(request_key(fleet, reads_of, kind) for kind in role.answers)
    lives = (_alive(fleet, writes_for[-1], role.name),) if role.lives else ()
    looks = (_alive(fleet, reads_of, role.name if reads_of != "*" else "*"),) if role.looks else ()
    return [
        _AccessRule("puts", ("put",), _IN, puts),
        _AccessRule("learns who reads", ("declare_subscriber",), _OUT, written),
        _AccessRule("subscribes", ("declare_subscriber",), _IN, reads),
        _AccessRule("reads", ("put",), _OUT, reads),
        _AccessRule("asks", ("query",), _IN, asks),
        _AccessRule("is answered", ("reply", "declare_queryable"), _OUT, asks),
        _AccessRule("answers", ("reply", "declare_queryable"), _IN, answers),
        _AccessRule("is asked", ("query",), _OUT, answers),
        _AccessRule("lives", ("liveliness_token",), _IN, lives),
        _AccessRule("looks", ("liveliness_query", "declare_liveliness_subscriber"), _IN, looks),
        _AccessRule("sees", ("liveliness_token",), _OUT, looks),
    ]


def may_write(role: Role, topic: Topic, robot: str = "") -> bool:
    """Whether a role writes a topic, of a robot or, with the robot ``-``, of a service for the whole fleet; with ``+``
    about many robots in one message."""
    if robot == BUNDLE and not topic.bundles:
        return False
    if not topic.per_service:
        return role.name == topic.writer and robot != NO_ONE
    return role.takes_over if topic is TAKEOVER else role.lives


def _alive(fleet: str, robot: str, service: str) -> str:
    return f"safedpa/{fleet}/{robot}/alive/{service}/*"


def _rights_of_a_router(fleet: str, robots: tuple[str, ...]) -> list[_AccessRule]:
    """Another router of the same fleet has judged its own clients; no one deletes, not even it.

    Where it may bring messages of some robots only, it may still tell what its clients want to read and ask.
    """
    everything = (f"safedpa/{fleet}/**",)
    brings = tuple(f"safedpa/{fleet}/{robot}/**" for robot in (*robots, NO_ONE)) if robots else everything
    return [
        _AccessRule("brings", _CARRIED, _IN, brings),
        _AccessRule("wants", _WANTED, _IN, everything),
        _AccessRule("takes away", (*_CARRIED, *_WANTED), _OUT, everything),
    ]


def rate_limits(fleet: str, robots: Iterable[str]) -> list[dict[str, Any]]:
    """Zenoh's ``downsampling``: how often each member may put under one key; what comes faster goes no further.

    Of every tick's topics, of each robot and of bundles, and of heartbeats. Each member is counted for itself.
    """
    names = tuple(robots)
    ticking = [topic for topic in TOPICS.values() if topic.delivery == "latest" and not topic.per_service]
    rules = [{"key_expr": key_of(fleet, robot, topic), "freq": _MOST_RATE} for topic in ticking for robot in names]
    rules += [{"key_expr": key_of(fleet, BUNDLE, topic), "freq": _MOST_RATE} for topic in ticking if topic.bundles]
    lives = [role.name for role in ROLES.values() if role.lives] + [ROUTER]
    rules += [
        {"key_expr": key_of(fleet, robot, HEALTH, service), "freq": _MOST_BEATS}
        for robot in (*names, NO_ONE, BUNDLE)
        for service in lives
    ]
    return [{"id": "rates", "flows": [_IN], "messages": ["put"], "rules": rules}] if names else []


def size_limits(fleet: str) -> list[dict[str, Any]]:
    """Zenoh's ``low_pass_filter``: what is larger than its topic allows goes no further than the router.

    Zenoh counts what goes next to a message, too.
    """
    by_size: dict[int, list[str]] = {}
    for topic in TOPICS.values():
        by_size.setdefault(topic.largest_bytes, []).append(key_of(fleet, "*", topic, "*"))
    return [
        {
            "id": f"at most {size} bytes",
            "flows": [_IN],
            "messages": ["put"],
            "key_exprs": keys,
            "size_limit": size + STAMP_BYTES,
        }
        for size, keys in by_size.items()
    ]
