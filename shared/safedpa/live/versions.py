"""Versions of a robot's model, and the folder that stores them across restarts."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, final

from safedpa.disk import write_through
from safedpa.errors import InputError, RecordingError
from safedpa.limits import parse_json, text_of_file

_STATE = "changes.json"


@dataclass(frozen=True)
class ModelVersion:
    """A model that was or is active, and its origin."""

    fingerprint: str
    document: str
    """Text of the model file."""
    margin: str = ""
    """The filter's margin for it as JSON; empty: the margin shipped with this model, or none."""
    change: int = 0
    """Number of the change that introduced it; 0: the initial model."""
    why: str = ""
    who: str = ""
    data: str = ""
    """Run and time range from which it was learned."""


@dataclass(frozen=True)
class OfferedEffect:
    """An effect that may be accepted, with its model. Without a document, the model is created on acceptance."""

    effect: str
    fingerprint: str = ""
    document: str = ""
    margin: str = ""
    data: str = ""


@dataclass(frozen=True)
class PersistedState:
    """State that survives a restart: the versions (the last one is active) and the number of the last change."""

    versions: tuple[ModelVersion, ...]
    change: int = 0
    offered: str = ""
    """Fingerprint of an offer that is not decided; empty without one."""
    rejected: tuple[tuple[int, str], ...] = field(default=())
    """(finding, effect)."""


@final
class VersionFolder:
    """A folder with the model and margin of each version, and a file with the state, which is replaced atomically."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def load(self) -> PersistedState | None:
        """Loads the stored state; None for a new folder. Raises InputError if it cannot be read."""
        path = self.folder / _STATE
        try:
            table = parse_json(text_of_file(path, "json_bytes"))
            versions = tuple(ModelVersion(**entry) for entry in table["versions"])
            rejected = tuple((int(number), str(effect)) for number, effect in table["rejected"])
            retained = PersistedState(versions, int(table["change"]), str(table["offered"]), rejected)
        except FileNotFoundError:
            return None
        except (OSError, ValueError, TypeError, KeyError, InputError) as error:
            raise InputError(f"{path}: cannot be read ({error}); move it away to start without it") from error
        if not retained.versions:
            raise InputError(f"{path}: got no version, wanted at least one; move it away to start without it")
        return retained

    def save(self, retained: PersistedState) -> None:
        """Stores the state. Raises RecordingError if that fails; the previous state then remains."""
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            newest = retained.versions[-1]
            stem = f"model-{newest.change:03d}-{newest.fingerprint}"
            write_through(self.folder / f"{stem}.toml", newest.document)
            if newest.margin:
                write_through(self.folder / f"{stem}.margin.json", newest.margin)
            # The state last: it refers to the files above, and a crash in between leaves the old state valid.
            table: dict[str, Any] = asdict(retained)
            write_through(self.folder / _STATE, json.dumps(table, indent=1))
        except OSError as error:
            raise RecordingError(f"{self.folder}: cannot be written ({error.strerror}); free space there") from error
