"""rosbag2 as it lies on disk: a folder of ``metadata.yaml`` and one or more files, packed or not."""

from __future__ import annotations

import json
import re
import tempfile
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

from safedpa.errors import RunError
from safedpa.extras import need
from safedpa.limits import limit, readable, text_of_file, too_much
from safedpa.records.bags.mcap_bag import McapBag
from safedpa.records.bags.messages_log import AbstractBag
from safedpa.records.bags.sqlite_bag import SqliteBag
from safedpa.records.run import Finding

__all__ = ["FolderBag", "PackedBag", "bag_in", "is_bag_folder"]

_ENDINGS = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd")
_MOST_FILES = 10_000
_KEY = re.compile(r"( +)([a-z_]+):[ \t]*(.*)")
_ITEM = re.compile(r" +- (.*)")


def is_bag_folder(path: Path) -> bool:
    """Whether a folder holds a bag: metadata, or files of one."""
    return path.is_dir() and bool((path / "metadata.yaml").is_file() or _files_in(path))


def _files_in(folder: Path) -> list[Path]:
    return sorted(item for item in folder.iterdir() if item.name.endswith(_ENDINGS) and item.is_file())


class FolderBag(AbstractBag):
    """All files of a folder as one bag, whatever order or index its metadata give."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, "rosbag2 folder")
        about = _metadata(path)
        self._files = list(dict.fromkeys(path / Path(name).name for name in about.files))
        there = [file for file in self._files if file.is_file()]
        if len(there) < len(self._files):
            lost = [file.name for file in self._files if not file.is_file()]
            self.findings.append(
                Finding(
                    "cut_off",
                    f"{len(lost)} of the bag's {len(self._files)} files are not there ({readable(lost[0])}); "
                    "read without",
                )
            )
        self._files = there or _files_in(path)
        if not self._files:
            raise RunError(f"{path}: metadata.yaml names no file that is there; wanted .mcap or .db3 files beside it")
        self._each = about.mode.upper() == "MESSAGE"
        if self._each and about.format != "zstd":
            raise RunError(
                f"{path}: messages are packed by '{readable(about.format)}'; wanted zstd; unpack with ros2 bag convert"
            )

    def messages(self, topics: Collection[str] | None) -> Iterator[tuple[str, int, bytes]]:
        """(topic, receipt in ns, encoded message), file after file."""
        for file in self._files:
            bag = bag_in(file)
            bag.declared = self.declared
            for name, at, data in bag.messages(topics):
                yield name, at, _unpacked(data) if self._each and data else data
            self.findings += bag.findings


class PackedBag(AbstractBag):
    """One file of a bag that was packed whole by zstd."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, "packed rosbag2")

    def messages(self, topics: Collection[str] | None) -> Iterator[tuple[str, int, bytes]]:
        """(topic, receipt in ns, encoded message) of what is unpacked beside, for as long as it is read."""
        with tempfile.TemporaryDirectory(prefix="safedpa-bag-") as folder:
            file = Path(folder) / self.path.name.removesuffix(".zstd")
            self._unpack(file)
            bag = bag_in(file)
            bag.declared = self.declared
            try:
                yield from bag.messages(topics)
            except RunError as error:
                raise RunError(str(error).replace(str(file), str(self.path))) from error
            self.findings += bag.findings

    def _unpack(self, to: Path) -> None:
        import zstandard

        left = max(limit("expansion_free_bytes"), self.path.stat().st_size * limit("expansion"))
        try:
            unpacker = zstandard.ZstdDecompressor(max_window_size=limit("bag_chunk_bytes"))
            with self.path.open("rb") as packed, to.open("wb") as out, unpacker.stream_reader(packed) as stream:
                while piece := stream.read(1 << 20):
                    left -= len(piece)
                    if left < 0:
                        raise too_much("expansion", "more", str(self.path))
                    out.write(piece)
        except zstandard.ZstdError as error:
            raise RunError(f"{self.path}: cannot be unpacked ({str(error)[:80]}); wanted one packed by zstd") from error


def bag_in(file: Path) -> AbstractBag:
    """The bag in one file, by its ending."""
    if file.name.endswith(".zstd"):
        return PackedBag(file)
    return SqliteBag(file) if file.suffix == ".db3" else McapBag(file)


def _unpacked(data: bytes) -> bytes:
    import zstandard

    most = limit("bag_message_bytes")
    try:
        with zstandard.ZstdDecompressor(max_window_size=most).stream_reader(data) as stream:
            found: bytes = stream.read(most + 1)
    except zstandard.ZstdError:
        return b""  # counted as unreadable
    if len(found) > most:
        raise too_much("bag_message_bytes", f"more than {most}")
    return found


@dataclass(frozen=True)
class _Metadata:
    """What of metadata.yaml is wanted; the files themselves say the rest."""

    files: tuple[str, ...] = ()
    mode: str = ""
    format: str = ""


def _metadata(folder: Path) -> _Metadata:
    """What metadata.yaml says; nothing without one, or where it is damaged: the files speak for themselves.

    Read line by line, as rosbag2 writes it, since YAML lets a kilobyte of references become any number of entries.
    """
    need("ros", what="reading ROS logs")
    path = folder / "metadata.yaml"
    if not path.is_file():
        return _Metadata()
    try:
        lines = text_of_file(path, "yaml_bytes").splitlines()
    except UnicodeDecodeError:
        return _Metadata()
    names: list[str] = []
    told: dict[str, str] = {}
    margin, key = None, ""
    for line in lines:
        entry = _KEY.fullmatch(line)
        if entry and margin in (None, entry[1]):
            margin, key = entry[1], entry[2]
            told.setdefault(key, _scalar(entry[3]))
        elif key == "relative_file_paths" and len(names) < _MOST_FILES and (item := _ITEM.fullmatch(line)):
            names.append(_scalar(item[1]))
    return _Metadata(tuple(filter(None, names)), told.get("compression_mode", ""), told.get("compression_format", ""))


def _scalar(written: str) -> str:
    """A YAML scalar on one line; empty where its quotes do not end."""
    text = written.strip()
    if text.startswith("'"):
        return text[1:-1].replace("''", "'") if len(text) > 1 and text.endswith("'") else ""
    if text.startswith('"'):
        try:
            return str(json.loads(text))
        except (ValueError, RecursionError):
            return ""
    return text
