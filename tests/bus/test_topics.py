"""The table of topics agrees with itself and with the nodes."""

import importlib
import inspect
import pkgutil
from collections import Counter
from typing import get_args

import pytest
from hypothesis import given
from hypothesis import strategies as some

import safedpa
from safedpa.bus import HEALTH, STATE, TOPICS, AbstractNode, Message, Topic, key_of, topic_of
from safedpa.bus.messages.topics import Delivery
from safedpa.bus.service.model_versions import ModelNode
from safedpa.errors import InputError

names = some.text("abcdefghijklmnopqrstuvwxyzABC0123456789_-.", min_size=1, max_size=12)


def nodes() -> list[type[AbstractNode]]:
    for info in pkgutil.walk_packages(safedpa.__path__, "safedpa."):
        if info.name.endswith(".node"):
            importlib.import_module(info.name)
    every = (*AbstractNode.__subclasses__(), *ModelNode.__subclasses__())
    return [node for node in every if node is not ModelNode and node.__module__.startswith("safedpa.")]


@given(names, names, some.sampled_from(list(TOPICS.values())), names)
def test_a_key_names_a_fleet_a_robot_and_a_topic(fleet: str, robot: str, topic: Topic, service: str) -> None:
    key = key_of(fleet, robot, topic, service)
    assert topic_of(key) == (fleet, robot, topic)
    assert key == f"safedpa/{fleet}/{robot}/{topic.name}" + (f"/{service}" if topic.per_service else "")
    assert key_of(fleet, "*", HEALTH, "*") == f"safedpa/{fleet}/*/health/*"


@pytest.mark.parametrize(
    "name",
    ["", "a/b", "a*", "**", "$*", "a#b", "a?b", "@a", "a\nb", "a\x00", "\x1b[2J", "a\u202eb", "a\u200b", "a" * 129],
)
def test_names_that_the_bus_cannot_carry_are_refused(name: str) -> None:
    for arguments in ((name, "r", STATE), ("f", name, STATE), ("f", "r", HEALTH, name)):
        with pytest.raises(InputError, match="name"):
            key_of(*arguments)


@pytest.mark.parametrize("name", ["a" * 128, "\u00e4" * 128, "\u8f66"])
def test_a_name_has_a_hundred_and_twenty_eight_letters_at_most_of_whatever_script(name: str) -> None:
    assert topic_of(key_of(name, name, STATE)) == (name, name, STATE)


@pytest.mark.parametrize(
    "key",
    [
        "safedpa/f/*/state",
        "safedpa/**",
        "safedpa/*/r/state",
        "safedpa/f/r/health/*",
        "safedpa/f/r/health/",
        "safedpa//r/state",
        "safedpa/f/@r/state",
        "safedpa/f/r$/state",
        "safedpa/f/r\n/state",
        f"safedpa/f/{'r' * 129}/state",
        f"safedpa/f/r/health/{'r' * 129}",
        "safedpa/f/r",
        "safedpa/f/r/state/more",
        "safedpa/f/r/health",
        "safedpa/f/r/takeover",
        "safedpa/f/r/model/diagnosis",
        "safedpa/f//state",
        "other/f/r/state",
        "safedpa/f/r/stat",
        "",
    ],
)
def test_keys_that_name_no_single_sender_are_refused(key: str) -> None:
    with pytest.raises(InputError, match=r"key|name"):
        topic_of(key)


def test_a_misspelt_topic_is_answered_with_the_nearest() -> None:
    with pytest.raises(InputError, match="did you mean 'state'"):
        topic_of("safedpa/f/r/stat")


def test_the_table_is_sound() -> None:
    for name, topic in TOPICS.items():
        assert topic.name == name
        assert issubclass(topic.message, Message)
        assert topic.delivery in get_args(Delivery)
        assert topic.largest_age_ticks >= 0
    kinds = Counter(topic.message for topic in TOPICS.values())
    assert max(kinds.values()) == 1, "a message type belongs to one topic"


SMALL, DOCUMENT = 65_536, 4_194_304
"""Bytes: 64 KiB, and 4 MiB for reports and model files."""
BY_HAND = {  # writer, delivery, ticks until it is stale (two seconds at 20 Hz: 40), most bytes, whether in bundles
    "state": ("robot", "latest", 0, SMALL, True),
    "scan": ("robot", "all", 40, SMALL, False),
    "surroundings": ("perception", "latest", 0, SMALL, False),
    "latent": ("adaptation", "latest", 0, SMALL, True),
    "nominal": ("policy", "latest", 0, SMALL, True),
    "action": ("safety_filter", "latest", 0, SMALL, True),
    "verdict": ("safety_filter", "all", 0, SMALL, True),
    "health": ("*", "latest", 40, SMALL, True),
    "finding": ("diagnosis", "all", 40, DOCUMENT, False),
    "model": ("diagnosis", "all", 0, DOCUMENT, False),
    "takeover": ("*", "all", 0, SMALL, False),
    "asked": ("diagnosis", "all", 0, SMALL, False),
    "setup": ("*", "all", 0, DOCUMENT, False),
    "roster": ("operator", "all", 40, SMALL, False),
}
"""What a control loop asks of each: an action of the last tick is one too old, and of what is only shown two seconds
are new enough; what is recorded for an audit is not replaced."""


@pytest.mark.parametrize("name", TOPICS)
def test_a_topic_is_what_was_agreed_of_it(name: str) -> None:
    topic = TOPICS[name]
    got = (topic.writer, topic.delivery, topic.largest_age_ticks, topic.largest_bytes, topic.bundles)
    assert got == BY_HAND[name]
    assert topic.per_service is (topic.writer == "*")


def test_every_input_of_every_node_has_exactly_one_producer() -> None:
    produced = Counter(topic for node in nodes() for topic in node.outputs)
    for node in nodes():
        for topic in node.inputs:
            assert produced[topic] == 1, f"{node.name} reads {topic.name}"


def test_nodes_write_what_the_table_says() -> None:
    assert {node.name for node in nodes()} >= {"adaptation", "policy", "safety_filter"}
    for node in nodes():
        assert not inspect.isabstract(node)
        assert 0.0 <= node.share < 1.0
        for topic in node.outputs:
            assert topic.writer in {node.name, "*"}
    written = {topic for node in nodes() for topic in node.outputs}
    assert {topic.writer for topic in TOPICS.values() if topic not in written} <= {
        "robot",
        "diagnosis",
        "operator",
        "*",
    }


def test_a_node_that_reads_an_output_runs_later_in_the_period() -> None:
    for node in nodes():
        for topic in node.inputs:
            writer = next(other for other in nodes() if topic in other.outputs)
            assert writer.share < node.share, f"{node.name} may give up on {topic.name} before it is due"
