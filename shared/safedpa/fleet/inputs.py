"""Digest of model, options and recordings, by which the result of a robot is recognised as current.

A recording with unchanged size and modification time counts as unchanged; otherwise its contents are compared.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

_BLOCK = 1 << 20


@dataclass(frozen=True)
class Options:
    """Options of the diagnosis of every robot: model, column map and user effects by path or name."""

    model: str
    columns: str | None = None
    horizon: float = 1.0
    effects: str | None = None
    scripts: str = "../../plotly.min.js"
    """Relative path from a robot's page to plotly.js, which the whole fleet shares."""


def options_digest(options: Options) -> str:
    """Returns a hex digest of all inputs but the recordings, including the version of the program."""
    digest = hashlib.sha256(f"{version('safedpa')} {options.horizon!r}".encode())
    for source in (options.model, options.columns, options.effects):
        files = _files_of(source)
        digest.update(f"|{'' if files else source}|".encode())
        for path in files:
            digest.update(f"{path.name} {path.stat().st_size} ".encode() + path.read_bytes())
    return digest.hexdigest()


def _files_of(source: str | None) -> list[Path]:
    """Returns the named file and, for a model, the weights next to it; empty for the name of a shipped file."""
    path = Path(source) if source else None
    if path is None or not path.is_file():
        return []
    weights = sorted(path.parent.glob("*.safetensors")) if path.suffix == ".toml" else []
    return [path, *weights]


def file_stamp(path: Path) -> dict[str, Any]:
    """Returns path, size, modification time and SHA-256 of a file. Raises OSError if it cannot be read."""
    status = path.stat()
    with path.open("rb") as file:
        digest = hashlib.sha256()
        while block := file.read(_BLOCK):
            digest.update(block)
    return {
        "path": str(path),
        "bytes": status.st_size,
        "modified_ns": status.st_mtime_ns,
        "sha256": digest.hexdigest(),
    }


def same_files(stamps: Iterable[Mapping[str, Any]], paths: Iterable[Path]) -> bool:
    """Whether the files are the stamped ones, possibly in another folder."""
    before, now = list(stamps), list(paths)
    if [Path(item["path"]).name for item in before] != [path.name for path in now]:
        return False
    try:
        return all(_same(item, path) for item, path in zip(before, now, strict=True))
    except OSError:
        return False


def _same(stamp: Mapping[str, Any], path: Path) -> bool:
    status = path.stat()
    if status.st_size != stamp["bytes"]:
        return False
    untouched = status.st_mtime_ns == stamp["modified_ns"] and str(path) == stamp["path"]
    return bool(untouched or file_stamp(path)["sha256"] == stamp["sha256"])
