"""What was opened and decided, as a small file beside what Save writes: with it the work goes on after any end."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from safedpa.errors import InputError
from safedpa.limits import parse_json, readable, text_of_file
from safedpa.records.atomic import atomic_path
from safedpa_services.workbench.recordings import Choice, Made

__all__ = ["NAME", "Decision", "Kept", "absolute", "newest_in", "place_for", "read_session", "write_session"]

NAME = "session.json"
Decision = tuple[str, str]
"""("added" or "rejected", effect)."""
_FORMAT = 1
_DONE = ("added", "rejected")
_MOST_FOLDERS = 1000


@dataclass(frozen=True)
class Kept:
    """One session: what was opened, and the decisions in their order."""

    choice: Choice
    decisions: tuple[Decision, ...] = ()


def read_session(path: Path) -> Kept:
    """Raises InputError for what is no session, naming the key."""
    try:
        document = parse_json(text_of_file(path, "json_bytes"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); wanted the {NAME} of a workbench") from error
    except InputError as error:
        raise InputError(f"{path}: {error}; wanted the {NAME} of a workbench") from error
    if not isinstance(document, dict) or document.get("format") != _FORMAT:
        raise InputError(f"{path}: wanted a session of the workbench with format = {_FORMAT}, as it writes {NAME}")
    try:
        runs = tuple(str(run) for run in document["runs"])
        decisions = tuple((str(item["do"]), str(item["effect"])) for item in document["decisions"])
        choice = Choice(str(document["model"]), runs, _columns(document["columns"]), float(document["horizon"]))
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: {type(error).__name__} at {error}; wanted model, runs, horizon, decisions"
        ) from error
    wrong = next((do for do, _ in decisions if do not in _DONE), None)
    if wrong is not None:
        raise InputError(f"{path}: decision '{readable(wrong, 40)}'; wanted {' or '.join(_DONE)}")
    return Kept(choice, decisions)


def write_session(kept: Kept, folder: Path) -> None:
    """Writes session.json, whole or not at all. Raises RecordingError where the folder cannot be written to."""
    columns = kept.choice.columns
    document = {
        "format": _FORMAT,
        "model": kept.choice.model,
        "runs": list(kept.choice.runs),
        "columns": {"text": columns.text, "beside": columns.beside} if isinstance(columns, Made) else columns,
        "horizon": kept.choice.horizon,
        "decisions": [{"do": do, "effect": effect} for do, effect in kept.decisions],
    }
    with atomic_path(folder / NAME) as temporary:
        temporary.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def _columns(told: Any) -> str | Made | None:
    if told is None or isinstance(told, str):
        return told
    return Made(str(told["text"]), str(told["beside"]))


def place_for(base: Path, choice: Choice) -> tuple[Path, tuple[Decision, ...]]:
    """The first of ``base``, ``base-2``, ... that holds the session of this choice, with what was decided in it, or
    nothing of another one."""
    wanted = absolute(choice)
    for folder in _folders(base):
        path = folder / NAME
        if not path.is_file():
            if not (folder / "model.toml").exists():
                return folder, ()
        elif (decisions := _decisions(path, wanted)) is not None:
            return folder, decisions
    raise InputError(
        f"{base}: {_MOST_FOLDERS} sessions of other recordings lie there; choose another folder with --out"
    )


def newest_in(base: Path) -> Path | None:
    """The session that was written last in ``base``, ``base-2``, ...; None where there is none."""
    found = []
    for folder in _folders(base):
        if not folder.is_dir():
            break
        found += [folder / NAME] if (folder / NAME).is_file() else []
    return max(found, key=lambda path: path.stat().st_mtime, default=None)


def absolute(choice: Choice) -> Choice:
    """The same with the paths of files that exist made absolute; names that ship stay names."""

    def whole(name: str) -> str:
        return str(Path(name).resolve()) if Path(name).is_file() else name

    columns = whole(choice.columns) if isinstance(choice.columns, str) else choice.columns
    columns = replace(columns, beside=whole(columns.beside)) if isinstance(columns, Made) else columns
    return replace(choice, model=whole(choice.model), runs=tuple(map(whole, choice.runs)), columns=columns)


def _decisions(path: Path, choice: Choice) -> tuple[Decision, ...] | None:
    """What was decided in the session of this choice; None in that of another one."""
    try:
        kept = read_session(path)
    except InputError:
        return None
    return kept.decisions if kept.choice == choice else None


def _folders(base: Path) -> Iterator[Path]:
    yield base
    yield from (base.with_name(f"{base.name}-{number}") for number in range(2, _MOST_FOLDERS + 1))
