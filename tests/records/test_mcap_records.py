"""MCAP files written byte by byte: damage, checksums and limits.

Source: mcap.dev, the specification: a checksum is CRC-32, and 0 means that there is none. The checksum of the data
section covers the file from its first byte to the record that holds it.
"""

import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import lz4.frame  # type: ignore[import-untyped]
import pytest
import zstandard

from safedpa.errors import RunError
from safedpa.limits import LimitError
from safedpa.records.readers.mcap import read_run_from_mcap
from safedpa.records.readers.mcap_recovery import DamageError, records_of
from safedpa.robots.car.system import CAR

START = b"\x89MCAP0\r\n"
DAMAGED = -1
PACKED: dict[str, Callable[[bytes], bytes]] = {
    "": lambda data: data,
    "zstd": lambda data: zstandard.ZstdCompressor().compress(data),
    "lz4": lz4.frame.compress,
}


def entry(opcode: int, content: bytes, length: int | None = None) -> bytes:
    return struct.pack("<BQ", opcode, len(content) if length is None else length) + content


HEAD = struct.pack("<HIQQ", 1, 2, 3, 4)
MESSAGE, FOOTER = entry(5, HEAD + b"data"), entry(2, bytes(20))
CHANNEL = entry(4, struct.pack("<HHIII", 1, 0, 0, 0, 0))


def mcap(folder: Path, *records: bytes) -> Path:
    path = folder / "a.mcap"
    path.write_bytes(START + b"".join(records))
    return path


def chunk(inside: bytes, how: str = "", *, more: int = 0, checksum: int = 0) -> bytes:
    """A chunk that declares ``more`` bytes than it holds."""
    packed, name = PACKED[how](inside), how.encode()
    head = struct.pack("<QQQII", 0, 0, len(inside) + more, checksum, len(name)) + name
    return entry(6, head + struct.pack("<Q", len(packed)) + packed)


def read(path: Path, *, validate: bool = False) -> int:
    """Number of records read; DAMAGED where the file is damaged."""
    try:
        return len(list(records_of(path, validate=validate)))
    except DamageError:
        return DAMAGED


@pytest.mark.parametrize(
    ("inside", "count"),
    [
        pytest.param(MESSAGE, 1, id="one message"),
        pytest.param(MESSAGE + entry(5, HEAD), 2, id="an empty message"),
        pytest.param(MESSAGE + entry(5, HEAD[:-1]), DAMAGED, id="a message without its head"),
        pytest.param(MESSAGE + entry(5, HEAD[:-1]) + MESSAGE, DAMAGED, id="without its head, before another"),
        pytest.param(MESSAGE + entry(0, b""), DAMAGED, id="opcode 0"),
        pytest.param(MESSAGE + entry(5, HEAD, 23), DAMAGED, id="longer than its chunk"),
        pytest.param(MESSAGE + entry(0x0C, b"xyz"), 1, id="another kind"),
        pytest.param(MESSAGE + b"\x05\x00", DAMAGED, id="cut off in its head"),
        pytest.param(MESSAGE + entry(0x80, b"") * 10_000 + MESSAGE, 2, id="ten thousand private records"),
        pytest.param(MESSAGE + entry(0x80, b"") * 10_001 + MESSAGE, DAMAGED, id="more private records"),
    ],
)
def test_records_of_a_chunk_are_read_or_the_chunk_is_damaged(inside: bytes, count: int, tmp_path: Path) -> None:
    path = mcap(tmp_path, chunk(inside), FOOTER)
    assert read(path) == count
    if count != DAMAGED:
        first = next(records_of(path))
        assert (first.channel_id, first.sequence, first.log_time, first.publish_time) == (1, 2, 3, 4)
        assert first.data == b"data"


@pytest.mark.parametrize(
    ("record", "repeated", "sound"),
    [
        pytest.param(entry(0x0A, bytes(40)), 10_001, True, id="an index is of a known kind"),
        pytest.param(entry(0x80, bytes(4)), 10_000, True, id="a private kind"),
        pytest.param(entry(0x80, bytes(40)), 10_001, False, id="too many of a private kind"),
        pytest.param(entry(0x0A, b""), 10_001, False, id="too many that are too short"),
        pytest.param(entry(0, bytes(40)), 1, False, id="opcode 0"),
    ],
)
def test_unknown_records_are_skipped_ten_thousand_times_at_most(record, repeated, sound, tmp_path):
    """Nine bytes each: a small file could keep a reader busy for long."""
    assert read(mcap(tmp_path, record * repeated, MESSAGE, FOOTER)) == (1 if sound else DAMAGED)


@pytest.mark.parametrize("how", PACKED)
@pytest.mark.parametrize(("more", "count"), [(-1, DAMAGED), (0, 2), (1, DAMAGED)])
def test_a_chunk_whose_length_differs_from_the_declared_one_is_damaged(how: str, more: int, count: int, tmp_path: Path):
    assert read(mcap(tmp_path, chunk(MESSAGE + MESSAGE, how, more=more), FOOTER)) == count


@pytest.mark.parametrize("validate", [True, False])
@pytest.mark.parametrize(("checksum", "sound"), [(0, True), (zlib.crc32(MESSAGE), True), (1, False)])
def test_a_wrong_checksum_of_a_chunk_is_noticed_when_validating(checksum, sound, validate, tmp_path):
    path = mcap(tmp_path, chunk(MESSAGE, checksum=checksum), FOOTER)
    assert read(path, validate=validate) == (1 if sound or not validate else DAMAGED)


@pytest.mark.parametrize("validate", [True, False])
@pytest.mark.parametrize(("checksum", "sound"), [(0, True), (zlib.crc32(START + MESSAGE), True), (1, False)])
def test_a_wrong_checksum_of_all_data_is_noticed_when_validating(checksum, sound, validate, tmp_path):
    path = mcap(tmp_path, MESSAGE, entry(15, struct.pack("<I", checksum)), FOOTER)
    assert read(path, validate=validate) == (1 if sound or not validate else DAMAGED)


@pytest.mark.parametrize(("longer", "count"), [(0, 1), (1, DAMAGED)])
def test_a_record_beyond_the_limit_is_damage_and_never_shortened(longer, count, tmp_path, monkeypatch):
    monkeypatch.setenv("SAFEDPA_LIMITS", "mcap_record_bytes=1000")
    data = b"x" * (1000 - len(HEAD) + longer)
    path = mcap(tmp_path, entry(5, HEAD + data), FOOTER)
    assert read(path) == count
    if count == 1:
        assert next(records_of(path)).data == data
    assert read(mcap(tmp_path, entry(0x0C, b" " * (1000 + longer)), FOOTER)) == (0 if count == 1 else DAMAGED)


@pytest.mark.parametrize(
    ("limits", "refused"),
    [
        ("mcap_chunk_bytes=2000", ""),
        ("mcap_chunk_bytes=1999", "got 2000 bytes, wanted at most 1999; .*mcap_chunk_bytes"),
        ("expansion=1,expansion_free_bytes=4000", ""),
        ("expansion=1,expansion_free_bytes=3999", "expansion"),
        ("expansion=1000,expansion_free_bytes=1", ""),
        ("mcap_channels=2", ""),
        ("mcap_channels=1", "got 2, wanted at most 1; .*mcap_channels"),
    ],
)
def test_chunks_are_measured_before_they_are_opened(limits, refused, tmp_path, monkeypatch):
    """Two chunks of 2000 bytes and one channel each, in a file that is shorter than one of them."""
    inside = CHANNEL + entry(0x0C, b" " * (2000 - 9 - len(CHANNEL)))
    path = mcap(tmp_path, chunk(inside, "zstd"), chunk(inside, "zstd"), FOOTER)
    assert len(inside) == 2000
    assert path.stat().st_size < 1000
    monkeypatch.setenv("SAFEDPA_LIMITS", limits)
    if refused:
        with pytest.raises(LimitError, match=refused):
            read(path)
    else:
        assert read(path) == 2


def test_channels_outside_of_chunks_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = mcap(tmp_path, CHANNEL, CHANNEL, FOOTER)
    monkeypatch.setenv("SAFEDPA_LIMITS", "mcap_channels=2")
    assert read(path) == 2
    monkeypatch.setenv("SAFEDPA_LIMITS", "mcap_channels=1")
    with pytest.raises(LimitError, match="mcap_channels"):
        read(path)


@pytest.mark.parametrize(
    ("records", "reason"),
    [((FOOTER,), ""), ((FOOTER[:3],), r" \(the recording was not closed: it is cut off at byte 11 .*\)")],
)
def test_a_recording_without_a_robot_is_refused_with_the_findings(records, reason, tmp_path):
    with pytest.raises(RunError, match=f"a.mcap: contains no state of a robot{reason}; wanted a recording of"):
        read_run_from_mcap(mcap(tmp_path, *records), CAR)
