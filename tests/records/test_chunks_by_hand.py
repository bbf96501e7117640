"""Checksums and lengths of chunks, and of all data of an MCAP file, that is written byte by byte.

Source: mcap.dev, the specification: a checksum is CRC-32, and 0 where there is none; that of the data section goes from
the file's first byte up to the record that holds it.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import lz4.frame  # type: ignore[import-untyped]
import pytest
import zstandard
from tests.records.test_logs_bounds_by_hand import FOOTER, MESSAGE, entry, mcap

from safedpa.errors import RunError
from safedpa.records.mcap_records import DamageError, records_of
from safedpa.records.mcap_run import read_run_from_mcap
from safedpa.robots.car.system import CAR

PACKED: dict[str, Callable[[bytes], bytes]] = {
    "": lambda data: data,
    "zstd": lambda data: zstandard.ZstdCompressor().compress(data),
    "lz4": lz4.frame.compress,
}


def chunk(inside: bytes, how: str = "", *, told: int = 0, checksum: int = 0) -> bytes:
    """A chunk that says to become ``told`` bytes more than it does."""
    packed, name = PACKED[how](inside), how.encode()
    head = struct.pack("<QQQII", 0, 0, len(inside) + told, checksum, len(name)) + name
    return entry(6, head + struct.pack("<Q", len(packed)) + packed)


def read(path: Path, *, validate: bool = True) -> int:
    """How many messages; -1 where the file is damaged."""
    try:
        return len(list(records_of(path, validate=validate)))
    except DamageError:
        return -1


@pytest.mark.parametrize("how", PACKED)
@pytest.mark.parametrize(("told", "messages"), [(-1, -1), (0, 2), (1, -1)])
def test_a_chunk_that_holds_more_or_less_than_it_says_is_damage(
    how: str, told: int, messages: int, tmp_path: Path
) -> None:
    assert read(mcap(tmp_path, chunk(MESSAGE + MESSAGE, how, told=told), FOOTER), validate=False) == messages


SUM = zlib.crc32(MESSAGE)


@pytest.mark.parametrize(("checksum", "sound"), [(0, True), (SUM, True), (SUM ^ 1, False)])
@pytest.mark.parametrize("validate", [True, False])
def test_a_chunk_is_what_was_written_where_its_checksum_says_so(
    checksum: int, sound: bool, validate: bool, tmp_path: Path
) -> None:
    """Whoever does not ask is not told."""
    path = mcap(tmp_path, chunk(MESSAGE, checksum=checksum), FOOTER)
    assert read(path, validate=validate) == (1 if sound or not validate else -1)


@pytest.mark.parametrize("validate", [True, False])
@pytest.mark.parametrize("wrong", [None, 0, 1])
def test_all_data_are_what_was_written_where_their_checksum_says_so(
    wrong: int | None, validate: bool, tmp_path: Path
) -> None:
    """None: the file has no checksum."""
    data = b"\x89MCAP0\r\n" + MESSAGE
    checksum = 0 if wrong is None else zlib.crc32(data) ^ wrong
    path = mcap(tmp_path, MESSAGE, entry(15, struct.pack("<I", checksum)), FOOTER)
    assert read(path, validate=validate) == (1 if not wrong or not validate else -1)


def test_a_message_without_its_head_is_damage_also_where_another_record_follows(tmp_path: Path) -> None:
    """Its head has 22 bytes: the last of them would be the next record's first."""
    headless = entry(5, MESSAGE[9:30])
    assert len(headless) == 9 + 21
    assert read(mcap(tmp_path, chunk(MESSAGE + headless + MESSAGE), FOOTER), validate=False) == -1
    whole = entry(5, MESSAGE[9:31])
    assert read(mcap(tmp_path, chunk(MESSAGE + whole + MESSAGE), FOOTER), validate=False) == 3


@pytest.mark.parametrize(("longer", "messages"), [(0, 1), (1, -1)])
def test_a_message_is_read_whole_or_not_at_all(
    longer: int, messages: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One that is longer than a record may be is not given shortened to what may be read at once."""
    monkeypatch.setenv("SAFEDPA_LIMITS", "mcap_record_bytes=1000")
    data = b"x" * (1000 - 22 + longer)
    path = mcap(tmp_path, entry(5, MESSAGE[9:31] + data), FOOTER)
    assert read(path, validate=False) == messages
    if messages == 1:
        (message,) = records_of(path, validate=False)
        assert message.data == data


@pytest.mark.parametrize(("private", "messages"), [(10_000, 2), (10_001, -1)])
def test_a_chunk_has_ten_thousand_records_that_nobody_knows_at_most(
    private: int, messages: int, tmp_path: Path
) -> None:
    """Nine bytes each: a small file could keep a reader busy for long."""
    inside = MESSAGE + entry(0x80, b"") * private + MESSAGE
    assert read(mcap(tmp_path, chunk(inside), FOOTER), validate=False) == messages


@pytest.mark.parametrize(
    ("records", "reason"),
    [((FOOTER,), ""), ((FOOTER[:3],), r" \(the recording was not closed: it ends at byte 11 .*\)")],
)
def test_a_recording_without_a_robot_is_refused_with_what_was_found(
    records: tuple[bytes, ...], reason: str, tmp_path: Path
) -> None:
    with pytest.raises(RunError, match=f"a.mcap: no robot's states in it{reason}; wanted a recording of"):
        read_run_from_mcap(mcap(tmp_path, *records), CAR)
