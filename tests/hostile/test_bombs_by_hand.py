"""Bombs are as large as their names say: what nobody has to refuse tests nothing."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Any

import pytest
import zstandard

from safedpa_lab.experiments.hostile import bombs
from safedpa_lab.experiments.hostile.bombs import BOMBS

MEBI = 2**20


def made(name: str) -> bytes:
    (bomb,) = (bomb for bomb in BOMBS if bomb.name == name)
    return bomb.make()


def records(file: bytes) -> Iterator[tuple[int, bytes]]:
    """Kind and body of each record of an MCAP file: one byte, eight for the length, the body."""
    assert file[:8] == b"\x89MCAP0\r\n"
    place = 8
    while place < len(file):
        kind, length = struct.unpack_from("<BQ", file, place)
        place += 9
        assert place + length <= len(file), "no record is cut off"
        yield kind, file[place : place + length]
        place += length


def told(chunk: bytes) -> int:
    """How many bytes a chunk says that it becomes."""
    return int(struct.unpack_from("<Q", chunk, 16)[0])


@pytest.mark.parametrize(("name", "size"), [("a file of 200 MB", 200), ("one line of 50 MB", 50)])
def test_a_file_is_as_large_as_it_says(name: str, size: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """In bytes where a mebibyte is one of them."""
    assert bombs._MEBI == MEBI
    monkeypatch.setattr(bombs, "_MEBI", 1)
    *head, last = made(name).split(b"\n")
    assert (len(last), len(head)) == (size, 1 if "line" in name else 0)


@pytest.mark.parametrize(
    ("name", "says"), [("a chunk of 2 GB in 65 KB", 2**31), ("a chunk that says less than it holds", 1000)]
)
def test_a_chunk_of_two_gigabytes(name: str, says: int, monkeypatch: pytest.MonkeyPatch) -> None:
    packed: list[int] = []

    class Packer:
        def __init__(self, level: int) -> None:
            assert level > 0

        def compressobj(self, size: int) -> Any:
            assert size == 2**31
            return self

        def compress(self, piece: bytes) -> bytes:
            packed.append(len(piece))
            return b""

        def flush(self) -> bytes:
            return b"packed"

    monkeypatch.setattr(zstandard, "ZstdCompressor", Packer)
    chunks = [body for kind, body in records(made(name)) if kind == 6]
    assert sum(packed) == 2**31
    assert [told(chunk) for chunk in chunks] == [says]
    assert chunks[0].endswith(b"packed")


def test_each_of_400_chunks_is_allowed_and_says_what_it_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    held: list[bytes] = []

    def compress(data: bytes, _level: int) -> bytes:
        held.append(data)
        return b"packed"

    monkeypatch.setattr(zstandard, "compress", compress)
    found = list(records(made("400 chunks of 8 MB")))
    assert [kind for kind, _ in found] == [1] + [6] * 401, "one header"
    (data,) = held
    assert {told(body) for _, body in found[1:]} == {len(data)}
    assert 0.99 * 8 * MEBI < len(data) <= 8 * MEBI
    assert data[:18] == (b"\x80" + bytes(8)) * 2


@pytest.mark.parametrize(("name", "first"), [("a million empty records", 0), ("a million private records", 0x80)])
def test_a_million_records(name: str, first: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nine bytes each; about as many, so that their number alone is what has to be refused."""
    monkeypatch.setattr(zstandard, "compress", lambda data, _level: data)
    file = made(name)
    assert 700_000 <= (len(file) - 8) / 9.0 <= 1_300_000
    assert file[8:17] == bytes([first, *[0] * 8])
