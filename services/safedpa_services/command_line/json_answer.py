"""``--json`` for commands that report progress in lines: the facts behind the lines become one JSON document."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from functools import wraps
from typing import Any, TypeVar

import click

from safedpa_services.command_line.options import as_json_option
from safedpa_services.plain_output import print_plain

_Function = TypeVar("_Function", bound=Callable[..., Any])
_KEY = "safedpa.facts"
"""Key in click's context under which a command with --json collects its facts."""


def answers_json(function: _Function) -> _Function:
    """Adds ``--json`` to a command: its lines are not printed, and its facts are at its end.

    Put it below the options.
    """

    @as_json_option
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
    """Prints the JSON document now, if one is wanted. For commands that then run until Ctrl-C."""
    context = click.get_current_context(silent=True)
    if context is not None and context.meta.get(_KEY):
        click.echo(json.dumps(context.meta[_KEY], allow_nan=False))
        context.meta[_KEY] = {}


def report_progress(line: str = "", *, err: bool = False, facts: Mapping[str, Any] | None = None) -> None:
    """Prints a line, or with ``--json`` collects its facts.

    Lists that are reported several times are concatenated. ``err``: print to standard error. Without a line, only the
    facts are reported.
    """
    context = click.get_current_context(silent=True)
    document = None if context is None else context.meta.get(_KEY)
    if document is None:
        if line:
            print_plain(line, err=err)
        return
    for name, value in (facts or {}).items():
        document[name] = [*document.get(name, ()), *value] if isinstance(value, list) else value
