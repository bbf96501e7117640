"""The files that a page may open: recordings and models in the folders given at the start."""

from __future__ import annotations

import glob
import itertools
import os
import stat
from collections.abc import Iterable
from pathlib import Path

from safedpa.errors import InputError, RunError
from safedpa.limits import readable

RECORDINGS = (".csv", ".parquet", ".mcap", ".db3", ".bag", ".ulg", ".npz", ".mat", ".h5")
_RECORDING = f"a recording ({', '.join(RECORDINGS[:-1])} or {RECORDINGS[-1]})"
_MODELS = (".toml",)
_MOST_FILES = 1000
_START_BYTES = 4096
_MAGIC = {
    ".parquet": b"PAR1",
    ".mcap": b"\x89MCAP0\r\n",
    ".db3": b"SQLite format 3\0",
    ".bag": b"#ROSBAG V2.0\n",
    ".ulg": b"ULog\x01\x12\x35",
    ".npz": b"PK\x03\x04",
    ".mat": b"MATLAB",
    ".h5": b"\x89HDF",
}


class FileStore:
    """Files in ``folders`` and their subfolders; symbolic links are resolved first."""

    def __init__(self, folders: Iterable[Path]) -> None:
        self._folders = list(dict.fromkeys(folder.resolve() for folder in folders))

    @classmethod
    def of(cls, files: Iterable[str], folders: Iterable[Path]) -> FileStore:
        """Returns a store of the given folders and of the folders of the given files; by default the current folder."""
        named = [*folders, *(Path(file).resolve().parent for file in files)]
        return cls(named or [Path()])

    @property
    def phrase(self) -> str:
        """The folders as text."""
        return ", ".join(map(str, self._folders))

    def with_folder(self, folder: Path) -> FileStore:
        """Returns a store with a further folder."""
        return FileStore([*self._folders, folder])

    def recordings(self, lines: Iterable[str]) -> list[str]:
        """Resolves paths and glob patterns to recordings. Raises RunError naming the first that may not be opened."""
        found: list[str] = []
        for line in lines:
            pattern = self._readable(line)
            if not pattern:
                continue
            matches = sorted(itertools.islice(glob.iglob(pattern), _MOST_FILES)) if self._may_look(pattern) else []
            found += [self.recording(path) for path in matches or [pattern]]
            if len(found) >= _MOST_FILES:
                raise RunError(f"{readable(line)}: got {_MOST_FILES} files or more; name fewer")
        return list(dict.fromkeys(found))

    def recording(self, path: str) -> str:
        """Returns the path of a recording.

        Raises RunError unless it is in a folder of the store and has the right content.
        """
        found = self._below(path, RECORDINGS, _RECORDING)
        with found.open("rb") as file:
            start = file.read(_START_BYTES)
        magic = _MAGIC.get(found.suffix.lower())
        if (magic is None and (b"\0" in start or b"-----BEGIN" in start)) or not start.startswith(magic or b""):
            raise self._refusal(path, _RECORDING)
        return str(found)

    def model(self, name: str, shipped: Iterable[str]) -> str:
        """Returns the path of a model file, or the name of a shipped model. Raises InputError otherwise."""
        if name in shipped or name.removesuffix(".toml") in shipped:
            return name
        return str(self._below(name, _MODELS, "a model file (.toml), or the name of one that ships"))

    def _below(self, path: str, endings: tuple[str, ...], wanted: str) -> Path:
        """Resolves a path. Every failure raises the same error, which does not reveal which files exist elsewhere."""
        try:
            found = Path(os.path.realpath(self._readable(path), strict=True))
            inside = next((folder for folder in self._folders if found.is_relative_to(folder)), None)
            hidden = inside is None or any(part.startswith(".") for part in found.relative_to(inside).parts)
            if hidden or found.suffix.lower() not in endings or not stat.S_ISREG(found.stat().st_mode):
                raise self._refusal(path, wanted)
        except (OSError, ValueError) as error:
            raise self._refusal(path, wanted) from error
        return found

    def _may_look(self, pattern: str) -> bool:
        """Returns whether all matches of a pattern are in the folders: its fixed part is, and it has neither ..

        nor **.
        """
        parts = Path(pattern).parts
        if ".." in parts or "**" in pattern:
            return False
        fixed = list(itertools.takewhile(lambda part: not glob.has_magic(part), parts))
        start = Path(os.path.realpath(Path(*fixed) if fixed else Path()))
        return len(fixed) == len(parts) or any(start.is_relative_to(folder) for folder in self._folders)

    @staticmethod
    def _readable(line: str) -> str:
        text = line.strip()
        if "\0" in text or len(text) > 4096:
            return "\1"  # no file has this name
        try:
            return str(Path(text).expanduser()) if text else ""
        except RuntimeError:  # ~user of an unknown user
            return "\1"

    def _refusal(self, path: str, wanted: str) -> InputError:
        return RunError(f"{readable(path)}: cannot be opened from here; wanted {wanted} below {self.phrase}")
