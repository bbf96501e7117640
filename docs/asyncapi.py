"""The bus as an AsyncAPI 3 document, with a JSON Schema of every message, for tools in other languages."""

from __future__ import annotations

import json
from typing import Any

import msgspec

from safedpa.bus import TOPICS

__all__ = ["document"]


def document() -> str:
    """The text of ``docs/reference/asyncapi.json``, made from the one table of topics."""
    (_, schemas) = msgspec.json.schema_components(
        [topic.message for topic in TOPICS.values()], ref_template="#/components/schemas/{name}"
    )
    channels: dict[str, Any] = {}
    operations: dict[str, Any] = {}
    messages: dict[str, Any] = {}
    for topic in TOPICS.values():
        name = topic.message.__name__
        messages[name] = {
            "name": name,
            "contentType": "application/msgpack",
            "payload": {"$ref": f"#/components/schemas/{name}"},
        }
        own = {"service": {"description": "who writes it"}} if topic.per_service else {}
        channels[topic.name] = {
            "address": f"safedpa/{{fleet}}/{{robot}}/{topic.name}" + ("/{service}" if own else ""),
            "parameters": {
                "fleet": {"description": "the fleet's name"},
                "robot": {"description": "the robot's name"},
                **own,
            },
            "messages": {name: {"$ref": f"#/components/messages/{name}"}},
        }
        operations[f"write_{topic.name}"] = {
            "action": "send",
            "summary": f"written by {'every service' if topic.per_service else topic.writer}",
            "channel": {"$ref": f"#/channels/{topic.name}"},
        }
    found = {
        "asyncapi": "3.0.0",
        "info": {
            "title": "safedpa",
            "version": "0.1.0",
            "description": "Messages are msgpack maps over Zenoh, in SI units and radians: see docs/reference/bus.md.",
        },
        "defaultContentType": "application/msgpack",
        "channels": channels,
        "operations": operations,
        "components": {"messages": messages, "schemas": schemas},
    }
    return json.dumps(found, indent=1) + "\n"
