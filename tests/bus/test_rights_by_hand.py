"""Under which keys a role may put messages, written out: about one robot, about many at once, about no robot."""

from __future__ import annotations

import pytest

from safedpa.bus.security.access import ROLES, access_control, may_write
from safedpa.bus.wire.topics import FINDING, HEALTH, MODEL, SETUP, STATE, TAKEOVER, WISH, Topic


@pytest.mark.parametrize(
    ("role", "topic", "robots"),
    [
        ("policy", WISH, "r+"),
        ("policy", STATE, ""),
        ("policy", HEALTH, "r+-"),
        ("policy", TAKEOVER, "r-"),
        ("diagnosis", FINDING, "r"),
        ("diagnosis", MODEL, "r"),
        ("diagnosis", TAKEOVER, ""),
        ("diagnosis", WISH, ""),
        ("diagnosis", SETUP, "r-"),
        ("robot", STATE, "r+"),
        ("robot", WISH, ""),
        ("operator", HEALTH, ""),
    ],
)
def test_a_role_writes_its_own_topics_about_robots_and_in_bundles_what_travels_in_them(
    role: str, topic: Topic, robots: str
) -> None:
    """``+`` stands for many robots in one message, ``-`` for none: a wish is always one robot's, a finding alone."""
    assert "".join(robot for robot in "r+-" if may_write(ROLES[role], topic, robot)) == robots


def test_the_router_takes_from_a_policy_these_keys_and_no_others() -> None:
    control = access_control("f", ["r"])
    own = {rule for policy in control["policies"] if "policy" in policy["subjects"] for rule in policy["rules"]}
    keys = {
        key
        for rule in control["rules"]
        if rule["id"] in own and "put" in rule["messages"] and rule["flows"] == ["ingress"]
        for key in rule["key_exprs"]
    }
    assert {key for key in keys if "/setup" not in key} == {
        "safedpa/f/r/wish",
        "safedpa/f/+/wish",
        "safedpa/f/r/health/policy",
        "safedpa/f/+/health/policy",
        "safedpa/f/-/health/policy",
        "safedpa/f/r/takeover/policy",
        "safedpa/f/-/takeover/policy",
    }
