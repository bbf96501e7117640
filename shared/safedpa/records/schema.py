"""JSON Schemas of the messages, for tools that know MCAP and not this project."""

from __future__ import annotations

import ast
import inspect
import json
from dataclasses import MISSING, fields
from functools import cache
from itertools import pairwise
from typing import Any

from safedpa.bus import messages
from safedpa.bus.messages import Message

__all__ = ["schema_of"]

_NUMBER = {"type": "number"}
_VECTOR = {"type": "array", "items": _NUMBER}
_TYPES: dict[str, dict[str, Any]] = {
    "Count": {"type": "integer", "minimum": 0},
    "Number": _NUMBER,
    "Positive": {"type": "number", "exclusiveMinimum": 0},
    "bool": {"type": "boolean"},
    "str": {"type": "string"},
    "Vector": _VECTOR,
    "Rows": {"type": "array", "items": _VECTOR},
    "tuple[str, ...]": {"type": "array", "items": {"type": "string"}},
}


def schema_of(kind: type[Message]) -> bytes:
    """The JSON Schema of a message's map of fields, with each field's meaning and unit in words."""
    meanings = {name: text for owner in reversed(kind.__mro__) for name, text in _meanings().get(owner.__name__, ())}
    properties = {
        item.name: {**_TYPES[str(item.type)], **({"description": meanings[item.name]} if item.name in meanings else {})}
        for item in fields(kind)
    }
    table = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": kind.__name__,
        "description": inspect.cleandoc(kind.__doc__ or ""),
        "type": "object",
        "properties": properties,
        "required": [item.name for item in fields(kind) if item.default is MISSING],
    }
    return json.dumps(table).encode()


@cache
def _meanings() -> dict[str, tuple[tuple[str, str], ...]]:
    """(field, meaning) pairs by message, from the texts below the fields; nothing where the source is not there."""
    try:
        tree = ast.parse(inspect.getsource(messages))
    except OSError:
        return {}
    classes = (node for node in tree.body if isinstance(node, ast.ClassDef))
    return {node.name: tuple(_of_body(node.body)) for node in classes}


def _of_body(body: list[ast.stmt]) -> list[tuple[str, str]]:
    found = []
    for node, following in pairwise(body):
        if not (isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)):
            continue
        if isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant):
            found.append((node.target.id, " ".join(str(following.value.value).split())))
    return found
