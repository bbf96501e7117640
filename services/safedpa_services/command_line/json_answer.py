"""``--json`` for commands that tell what they did in lines: the facts behind the lines become one document."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from functools import wraps
from typing import Any, TypeVar

import click

from safedpa_services.lines import print_plain

__all__ = ["answers_json", "finish", "report_progress"]

_Function = TypeVar("_Function", bound=Callable[..., Any])
_KEY = "safedpa.facts"
"""In the context of a command that was called with --json: what it has told so far."""


def answers_json(function: _Function) -> _Function:
    """Gives a command ``--json``: of its lines nothing is printed, at its end the facts are. Use below its options."""

    @click.option("--json", "as_json", is_flag=True, help="print one JSON document and nothing else")
    @wraps(function)
    def answered(*arguments: Any, as_json: bool, **options: Any) -> Any:
        context = click.get_current_context()
        if as_json:
            context.meta[_KEY] = {}
        result = function(*arguments, **options)
        finish()
        return result

    return answered  # type: ignore[return-value]


def finish() -> None:
    """Prints the document, where one is wanted and was not printed before: what serves for hours says it at once."""
    context = click.get_current_context(silent=True)
    if context is not None and context.meta.get(_KEY):
        click.echo(json.dumps(context.meta[_KEY], allow_nan=False))
        context.meta[_KEY] = {}


def report_progress(line: str = "", *, err: bool = False, facts: Mapping[str, Any] | None = None) -> None:
    """Prints a line, or with ``--json`` takes the facts down; the entries of lists that are told twice follow one
    another. ``err``: the line belongs on standard error. Without a line only the facts are told."""
    context = click.get_current_context(silent=True)
    document = None if context is None else context.meta.get(_KEY)
    if document is None:
        if line:
            print_plain(line, err=err)
        return
    for name, value in (facts or {}).items():
        document[name] = [*document.get(name, ()), *value] if isinstance(value, list) else value
