"""Versions of a robot's model, and the folder in which they outlive the process that agrees on them."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, final

from safedpa.disk import write_through
from safedpa.errors import InputError, RecordingError
from safedpa.limits import parse_json, text_of_file

__all__ = ["ModelVersion", "OfferedEffect", "PersistedState", "VersionFolder"]

_STATE = "changes.json"


@dataclass(frozen=True)
class ModelVersion:
    """One model that was or is in force, and where it came from."""

    fingerprint: str
    document: str
    """The model file's text."""
    margin: str = ""
    """The filter's margin for it, as JSON text; empty: the shipped one of this model, or none."""
    change: int = 0
    """Number of the change that brought it; 0: the robot began with it."""
    why: str = ""
    who: str = ""
    data: str = ""
    """Which stretch of which run it was learned from."""


@dataclass(frozen=True)
class OfferedEffect:
    """An effect that may be accepted, and the model with it; without a document it is made when it is accepted."""

    effect: str
    fingerprint: str = ""
    document: str = ""
    margin: str = ""
    data: str = ""


@dataclass(frozen=True)
class PersistedState:
    """What must outlive the process: versions, the last one in force, and how far changes were counted."""

    versions: tuple[ModelVersion, ...]
    change: int = 0
    offered: str = ""
    """Fingerprint of what is offered and not decided, else empty."""
    rejected: tuple[tuple[int, str], ...] = field(default=())
    """(finding, effect)."""


@final
class VersionFolder:
    """A folder with one file for each version's model and margin, and one with the state, replaced as a whole."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def load(self) -> PersistedState | None:
        """What was kept before; None in a new folder. Raises InputError when it cannot be read."""
        path = self.folder / _STATE
        try:
            table = parse_json(text_of_file(path, "json_bytes"))
            versions = tuple(ModelVersion(**entry) for entry in table["versions"])
            rejected = tuple((int(number), str(effect)) for number, effect in table["rejected"])
            retained = PersistedState(versions, int(table["change"]), str(table["offered"]), rejected)
        except FileNotFoundError:
            return None
        except (OSError, ValueError, TypeError, KeyError, InputError) as error:
            raise InputError(f"{path}: cannot be read ({error}); move it away to begin without it") from error
        if not retained.versions:
            raise InputError(f"{path}: got no version, wanted at least one; move it away to begin without it")
        return retained

    def save(self, retained: PersistedState) -> None:
        """Keeps it before anybody acts on it. Raises RecordingError when that fails; what was kept before stays."""
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            newest = retained.versions[-1]
            stem = f"model-{newest.change:03d}-{newest.fingerprint}"
            write_through(self.folder / f"{stem}.toml", newest.document)
            if newest.margin:
                write_through(self.folder / f"{stem}.margin.json", newest.margin)
            table: dict[str, Any] = asdict(retained)
            write_through(self.folder / _STATE, json.dumps(table, indent=1))
        except OSError as error:
            raise RecordingError(f"{self.folder}: cannot be written ({error.strerror}); free space there") from error
