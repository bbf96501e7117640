"""The provenance of a result: how to make it again, and with which code and machine it was made."""

from __future__ import annotations

import hashlib
import json
import math
import os
import platform
import shlex
import subprocess
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path, PurePath
from typing import Any

import click

import safedpa
from safedpa.errors import InputError
from safedpa.records.writers.tables import atomic_path
from safedpa_lab.provenance.code import digests

KEY, CONTENT = "provenance", "content"
"""Of the table that a file of results holds, and in it of the digest of the whole file."""

_PACKAGES = ("numpy", "piqp", "pymunk", "torch")
_ELSEWHERE = (
    "out", "page", "record", "keep", "recordings", "models", "baselines", "data", "file", "markdown", "picture",
    "pictures", "peers",
)  # fmt: skip
"""Options that name a path on a machine: they do not change a result."""
_NO_RESULT = ("as_json", "processes", "workers", "jobs", "listed", "resume")
"""Options on which no result depends."""


def write_result(path: Path, result: Mapping[str, Any]) -> None:
    """Writes a result as JSON, whole or not at all, with its provenance, where the command of this context made it.

    Values that are not finite become null, which JSON lacks: hours of work are not lost for one number.
    """
    document = _plain({**result, KEY: provenance()})
    document[KEY][CONTENT] = content_digest(document)
    with atomic_path(path) as unfinished:
        unfinished.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def content_digest(document: Mapping[str, Any]) -> str:
    """Returns a digest of everything in a document of results but itself: what was edited later has another one."""
    retained = {name: value for name, value in document[KEY].items() if name != CONTENT}
    text = json.dumps({**document, KEY: retained}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def require_same_maker(path: Path, document: Mapping[str, Any]) -> None:
    """Raises InputError unless this command and today's code made a document, and that it was not edited since.

    Otherwise an experiment that continues it would give the cases of other code its own provenance.
    """
    then, now = document.get(KEY), provenance()
    if not isinstance(then, dict) or then.get(CONTENT) != content_digest(document):
        raise InputError(f"{path}: has no provenance, or was edited since it was made; name a new file")
    if then["code"] != now["code"]:
        raise InputError(f"{path}: its cases were made by other code than today's; name a new file")
    if then["command"] != now["command"]:
        raise InputError(f"{path}: was made by '{then['command']}', not by '{now['command']}'; name a new file")


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _plain(one) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(one) for one in value]
    if value is None or isinstance(value, (str, int)):
        return value
    number = float(value)
    return number if math.isfinite(number) else None


def provenance() -> dict[str, Any]:
    """Command and what was chosen for it, date, commit, machine and load, versions, digests of the code behind it."""
    context = click.get_current_context(silent=True)
    module = None if context is None else _module(context.command)
    return {
        "command": None if context is None else command_line(context),
        "module": module,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "commit": _commit(),
        "machine": {
            "cores": os.cpu_count(),
            "load": round(os.getloadavg()[0], 1),
            "python": platform.python_version(),
            **{name: found for name in _PACKAGES if (found := installed_version(name)) is not None},
        },
        "code": {} if module is None else digests(module),
    }


def _module(command: click.Command) -> str | None:
    """The module whose code the command's results depend on."""
    experiment = getattr(command, "experiment", None)  # commands generated from a record share one callback
    if experiment is not None:
        return str(experiment.module)
    return None if command.callback is None else command.callback.__module__


def command_line(context: click.Context) -> str:
    """The command line with every given option that changes the result."""
    phrase: list[str] = []
    for item in context.command.params:
        value = context.params.get(item.name or "")
        elsewhere = item.name in _ELSEWHERE and not isinstance(value, bool)
        if elsewhere or item.name in _NO_RESULT or value is None or value == item.get_default(context):
            continue
        many = isinstance(value, (tuple, list)) and (item.multiple if isinstance(item, click.Option) else True)
        for one in value if many else (value,):
            phrase += _text(item, one)
    return f"{context.command_path} {shlex.join(phrase)}".strip()


def _text(item: click.Parameter, value: Any) -> Sequence[str]:
    """As typed on the command line; of a path only the last part."""
    reported = [str(one) for one in (value if isinstance(value, (tuple, list)) else (value,))]
    reported = [
        PurePath(one).name if isinstance(value, Path) or PurePath(one).is_absolute() else one for one in reported
    ]
    if isinstance(item, click.Argument):
        return reported
    if isinstance(value, bool):
        return ((item.opts if value else item.secondary_opts or item.opts)[0],)
    if isinstance(item, click.Option) and item.count:
        return [item.opts[0]] * int(value)
    return (item.opts[0], *reported)


def _commit() -> str | None:
    """Of the sources, with "+" where files that are followed differ from it; None where they lie in no repository of
    their own, such as in an environment within another project's."""
    assert safedpa.__file__ is not None
    folder = Path(safedpa.__file__).parent
    try:
        _git(folder, "ls-files", "--error-unmatch", "__init__.py")
        commit = _git(folder, "rev-parse", "--short=12", "HEAD")
        changed = _git(folder, "status", "--porcelain", "--untracked-files=no", ":/shared", ":/services", ":/sim")
        return f"{commit}+" if changed else commit
    except (OSError, subprocess.SubprocessError):
        return None


def _git(folder: Path, *phrase: str) -> str:
    done = subprocess.run(["git", *phrase], cwd=folder, capture_output=True, text=True, timeout=20, check=True)
    return done.stdout.strip()


def installed_version(name: str) -> str | None:
    """None where there is no such package."""
    try:
        return version(name)
    except PackageNotFoundError:
        return None
