"""Which results are older than the code that made them."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safedpa.errors import InputError
from safedpa_lab.provenance.code import digests
from safedpa_lab.provenance.record import CONTENT, KEY, content_digest


@dataclass(frozen=True)
class Standing:
    """A file of results, or a row of a benchmark, compared with the current code."""

    name: str
    command: str | None
    date: str | None
    commit: str | None
    changed: tuple[str, ...]
    """Packages whose code or data has changed since."""
    rooms: int
    """Number of packages that its code uses; 0 if it was not recorded."""
    edited: bool = False
    """Whether it was edited since it was made."""

    @property
    def is_current(self) -> bool:
        """Whether the current code made it, and it was not edited since."""
        return self.rooms > 0 and not self.changed and not self.edited

    @property
    def reported(self) -> str:
        """As text: current, older in a number of packages, edited, or unknown."""
        if self.edited:
            return "edited since it was made"
        if not self.rooms:
            return "made before provenance was recorded"
        if not self.changed:
            return "made by the current code"
        return f"older than its code in {len(self.changed)} of {self.rooms} packages"


def standings(folder: Path) -> Iterator[Standing]:
    """Every ``*.json`` of the folder, by name. Raises InputError for a folder without any, or for invalid JSON."""
    files = sorted(folder.glob("*.json")) if folder.is_dir() else []
    if not files:
        raise InputError(f"{folder}: got no file of results (*.json) there; name the folder that holds them")
    for path in files:
        try:
            found = json.loads(path.read_text(encoding="utf-8"))
        except ValueError as error:
            raise InputError(f"{path}: got no JSON ({error}); make it again") from error
        rows = _table(found).get("rows")
        if isinstance(rows, dict):  # of a benchmark: each was measured by itself
            yield from (_standing(f"{path.name}: {name}", row) for name, row in rows.items())
        else:
            yield _standing(path.name, found)


def _standing(name: str, document: Any) -> Standing:
    """Without a record nothing is known; every package of a module that no longer exists counts as changed."""
    document = _table(document)
    retained = _table(document.get(KEY))
    module, then = retained.get("module"), _table(retained.get("code"))
    if not isinstance(module, str):
        then = {}
    now = digests(module) if isinstance(module, str) and then else {}
    changed = tuple(sorted(room for room in {*then, *now} if then.get(room) != now.get(room)))
    reported = {key: _text(retained.get(key, document.get(key))) for key in ("command", "date", "commit")}
    edited = CONTENT in retained and retained[CONTENT] != content_digest(document)
    return Standing(name, **reported, changed=changed, rooms=len({*then, *now}), edited=edited)


def _table(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _text(value: Any) -> str | None:
    return value if isinstance(value, str) else None
