"""The router's access control as it is generated: complete, closed, from the table of topics."""

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safedpa.bus import TOPICS
from safedpa.bus.messages.topics import STAMP_BYTES
from safedpa.bus.security.access_control import ROLES, access_control, may_write, rate_limits, roles_of, size_limits
from safedpa.errors import InputError

NAMES = st.lists(st.from_regex(r"[a-z0-9_.][a-z0-9_.-]{0,8}", fullmatch=True), unique=True, max_size=5)

LOOP = {"adaptation", "policy", "safety_filter"}
BEATING = LOOP | {"dashboard", "diagnosis", "metrics", "perception", "recorder", "robot.r", "workbench"}
SEVERAL = {"health": BEATING, "setup": BEATING, "takeover": LOOP}
"""Who writes what is not one service's: who only asks, as an operator does, writes none of it."""


def keys_of(control: dict[str, Any], subject: str, message: str, flow: str) -> set[str]:
    allowed = {rule for policy in control["policies"] if subject in policy["subjects"] for rule in policy["rules"]}
    rules = [rule for rule in control["rules"] if rule["id"] in allowed]
    return {key for rule in rules if message in rule["messages"] and flow in rule["flows"] for key in rule["key_exprs"]}


@given(NAMES)
@settings(max_examples=20)
def test_it_is_on_and_closed_and_every_rule_belongs_to_a_role(robots: list[str]) -> None:
    control = access_control("f", robots)
    assert control["enabled"] is True
    assert control["default_permission"] == "deny"
    assert {rule["permission"] for rule in control["rules"]} == {"allow"}
    assert not any("delete" in rule["messages"] for rule in control["rules"])
    used = [rule for policy in control["policies"] for rule in policy["rules"]]
    assert sorted(used) == sorted(rule["id"] for rule in control["rules"])
    assert len(set(used)) == len(used)
    names = {name for subject in control["subjects"] for name in subject.get("cert_common_names", ())}
    assert names == set(roles_of(robots))


@given(NAMES)
@settings(max_examples=20)
def test_the_right_to_put_names_robots_one_by_one(robots: list[str]) -> None:
    control = access_control("f", robots)
    for role in set(roles_of(robots)) - {"router"}:
        assert not any("*" in key for key in keys_of(control, role, "put", "ingress"))
    for robot in robots:
        mine = keys_of(control, f"robot.{robot}", "put", "ingress")
        assert {key.split("/")[2] for key in mine} == {robot}
        assert f"safedpa/f/{robot}/state" in mine
        assert f"safedpa/f/{robot}/action" not in mine


@pytest.mark.parametrize(("message", "flow"), [("put", "ingress"), ("declare_subscriber", "egress")])
def test_every_topic_has_its_writer_who_hears_of_its_readers_and_no_other(message: str, flow: str) -> None:
    """A publisher that hears of no reader sends nothing."""
    control = access_control("f", ["r"])
    for topic in TOPICS.values():
        writers = {
            role
            for role in set(roles_of(["r"])) - {"router"}
            if any(key.split("/")[3] == topic.name for key in keys_of(control, role, message, flow))
        }
        only = {"robot.r" if topic.writer == "robot" else topic.writer}
        assert writers == (SEVERAL[topic.name] if topic.writer == "*" else only), topic.name


@pytest.mark.parametrize(
    ("role", "topic", "robots"),
    [
        ("policy", "nominal", "r+"),
        ("policy", "state", ""),
        ("policy", "health", "r+-"),
        ("policy", "takeover", "r-"),
        ("diagnosis", "finding", "r"),
        ("diagnosis", "model", "r"),
        ("diagnosis", "takeover", ""),
        ("diagnosis", "nominal", ""),
        ("diagnosis", "setup", "r-"),
        ("robot", "state", "r+"),
        ("robot", "nominal", ""),
        ("operator", "health", ""),
    ],
)
def test_a_role_writes_its_own_topics_about_one_robot_many_or_none(role: str, topic: str, robots: str) -> None:
    """``+`` stands for a bundle about many robots, ``-`` for a service of the whole fleet."""
    assert "".join(robot for robot in "r+-" if may_write(ROLES[role], TOPICS[topic], robot)) == robots


def test_the_router_takes_from_a_policy_these_keys_and_no_others() -> None:
    assert keys_of(access_control("f", ["r"]), "policy", "put", "ingress") == {
        "safedpa/f/r/nominal", "safedpa/f/+/nominal",
        "safedpa/f/r/health/policy", "safedpa/f/+/health/policy", "safedpa/f/-/health/policy",
        "safedpa/f/r/takeover/policy", "safedpa/f/-/takeover/policy",
        "safedpa/f/r/setup/policy", "safedpa/f/-/setup/policy",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("name", "robots", "refused"),
    [("router.west", (), False), ("router.west", ("r1",), False), ("router", (), True), ("policy", (), True),
     ("west", (), True), ("router.west", ("",), True), ("router.west", ("*",), True)],
)  # fmt: skip
def test_a_linked_router_has_a_name_of_its_own(name: str, robots: tuple[str, ...], refused: bool) -> None:
    if refused:
        with pytest.raises(InputError):
            access_control("f", ["r1"], {name: robots})
        return
    subjects = [subject["id"] for subject in access_control("f", ["r1"], {name: robots})["subjects"]]
    assert {name, "router"} <= set(subjects)


def test_strangers_have_a_right_to_nothing() -> None:
    control = access_control("f", ["r"])
    everybody = {key for message in ("put", "query") for key in keys_of(control, "everybody", message, "ingress")}
    assert everybody == {"safedpa/-/-/nothing"}


@pytest.mark.parametrize("robots", [["*"], ["-"], ["a/b"], ["r", "r"], [""], ["$x"]])
def test_names_that_would_widen_a_rule_are_refused(robots: list[str]) -> None:
    with pytest.raises(InputError):
        access_control("f", robots)
    with pytest.raises(InputError):
        access_control(robots[0] if len(robots) == 1 else "*", ["r"])


def test_every_topic_has_a_size() -> None:
    limits = size_limits("f")
    of = {key.split("/")[3]: limit["size_limit"] for limit in limits for key in limit["key_exprs"]}
    assert of == {topic.name: topic.largest_bytes + STAMP_BYTES for topic in TOPICS.values()}


def test_every_service_that_writes_a_topic_is_a_role() -> None:
    assert {topic.writer for topic in TOPICS.values()} - {"*"} <= set(ROLES)


def rights_of(subject: str, robots: list[str], message: str, flow: str) -> set[str]:
    return keys_of(access_control("f", robots), subject, message, flow)


def test_a_process_shows_that_it_lives_under_its_own_name_only() -> None:
    """A robot of itself, a service of the whole fleet; who only asks is no member."""
    robots = ["r1", "r2"]
    for role in set(roles_of(robots)) - {"router", "operator", "healthcheck"}:
        name, _, robot = role.partition(".")
        assert rights_of(role, robots, "liveliness_token", "ingress") == {f"safedpa/f/{robot or '-'}/alive/{name}/*"}
    for role in ("operator", "healthcheck"):
        assert rights_of(role, robots, "liveliness_token", "ingress") == set()


LOOKING = {"dashboard", "workbench", "operator", "healthcheck"}


@pytest.mark.parametrize("role", sorted(set(roles_of(())) - {"router"}))
def test_pages_and_operators_may_see_who_lives_and_no_other_service_may(role: str) -> None:
    everybody = {"safedpa/f/*/alive/*/*"} if role in LOOKING else set()
    for message in ("liveliness_query", "declare_liveliness_subscriber"):
        assert rights_of(role, ["r"], message, "ingress") == everybody
    assert rights_of(role, ["r"], "liveliness_token", "egress") == everybody


def test_a_robot_looks_at_itself_alone() -> None:
    for message, flow in (("liveliness_query", "ingress"), ("liveliness_token", "egress")):
        assert rights_of("robot.r1", ["r1", "r2"], message, flow) == {"safedpa/f/r1/alive/robot/*"}


def test_messages_of_a_tick_are_limited_in_rate_and_those_that_must_not_be_lost_are_not() -> None:
    """Each rule is about one topic of one robot or of bundles."""
    assert rate_limits("f", []) == []
    (limits,) = rate_limits("f", ["r1", "r2"])
    keys = [rule["key_expr"].split("/") for rule in limits["rules"]]
    ticking = {name for name, topic in TOPICS.items() if topic.delivery == "latest" and not topic.per_service}
    bundled = {name for name in ticking if TOPICS[name].bundles}
    for robot, topics in (("r1", ticking), ("r2", ticking), ("+", bundled)):
        assert sorted(key[3] for key in keys if key[2] == robot and key[3] != "health") == sorted(topics)
    assert {len(key) for key in keys if key[3] == "health"} == {5}, "a heartbeat is of its service alone"


def test_a_member_may_beat_a_hundred_times_a_second_and_tick_eight_times_as_fast_as_the_fastest_robot() -> None:
    (limits,) = rate_limits("f", ["r"])
    rates = {rule["key_expr"].split("/")[3]: rule["freq"] for rule in limits["rules"]}
    assert rates.pop("health") == 100.0
    assert set(rates.values()) == {8 * 500.0}
