"""Small inputs that ask for much are refused within a second and 200 MB, with one line that says why."""

import json
import struct
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import zstandard

from safedpa_lab.experiments.hostile.bombs import BOMBS, Bomb

# A second of a machine whose processor counts to a million in 60 ms; a slower or busier one is given its own measure.
SECONDS, REFERENCE, MEGABYTES = 1.0, 0.06, 200.0
PATIENCE = 40
LONG = ("30 million equal rows", "a gigabyte in a megabyte", "3000 members")
"""Bombs that take seconds to make."""
_PROGRAM = """
import json, os, signal, sys, time
from pathlib import Path
import numpy, pyarrow.parquet, pyarrow.csv, zstandard, lz4.frame, mcap.reader, safetensors
import rosbags.typesys, pyulog.core
import safedpa.records.readers.mcap
from safedpa.bus import ModelMessage
from safedpa.bus.messages.codec import decode
from safedpa.dynamics import load_model
from safedpa.errors import InputError
from safedpa.limits import check_archive
from safedpa.networks import load_weights
from safedpa.records import load_column_map, load_run
from safedpa.records.readers.own_process import in_this_process
from safedpa.robots.car.system import CAR
from safedpa.safety.margins.calibration import margin_from_text
from safedpa.ros.definitions import known_fields
known_fields(False), known_fields(True)
def run(path):
    return load_run(path, CAR)
def bag(path):
    return load_run(path, CAR, load_column_map("f1tenth_bag"))
def folder(path):
    (path.parent / "bag").mkdir(exist_ok=True)
    path.rename(path.parent / "bag" / "metadata.yaml")
    return bag(path.parent / "bag")
LOADERS = {
    ".toml": load_model, ".map": lambda path: load_column_map(str(path)), ".csv": run, ".parquet": run, ".mcap": run,
    ".bag": bag, ".db3": bag, ".ulg": bag, ".zstd": lambda path: bag(path.rename(path.with_name("bag.mcap.zstd"))),
    ".yaml": folder, ".safetensors": load_weights, ".npz": check_archive,
    ".msgpack": lambda path: decode(ModelMessage, path.read_bytes()),
    ".json": lambda path: margin_from_text(path.read_text(encoding="utf-8")),
}
from safedpa_lab.experiments.hostile.bombs import BOMBS
def count():
    began = time.process_time()
    for number in range(1_000_000):
        number * number
    return time.process_time() - began
def memory(name):
    line = next(line for line in open("/proc/self/status") if line.startswith(name))  # of this program alone
    return float(line.split()[1]) / 1024.0
loaded = memory("VmRSS")
def refuse(path):
    reference = count()
    at_first, began = memory("VmRSS"), time.process_time()
    try:
        with in_this_process():
            LOADERS[path.suffix](path)
        refusal = ""
    except InputError as error:
        refusal = str(error)
    except Exception as error:
        refusal = f"HOLE {type(error).__name__}: {error}"[:300]
    spent = time.process_time() - began
    # A fork holds what it touched of the libraries alone, and would seem to need less than a new program.
    return [refusal, spent, max(reference, count()), loaded + memory("VmHWM") - at_first]
def apart(work):
    child = os.fork()
    if child:
        return os.waitpid(child, 0)[1]
    try:
        signal.alarm(int(sys.argv[1]))
        work()
        sys.stdout.flush()
    except BaseException as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr, flush=True)
        os._exit(1)
    os._exit(0)
for line in sys.stdin:
    number, path = json.loads(line)
    ended = apart(lambda: Path(path).write_bytes(BOMBS[number].make()))
    ended = ended or apart(lambda: print(json.dumps(refuse(Path(path)))))
    if ended:
        print(json.dumps(f"ended with status {ended}"), flush=True)
"""


@pytest.fixture(scope="module")
def program() -> Iterator[subprocess.Popen[str]]:
    """Has everything imported, and makes and judges each bomb in a process of its own: 0.6 s less for each of them."""
    command = [sys.executable, "-c", _PROGRAM, str(PATIENCE)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as running:
        yield running
        assert running.stdin is not None
        running.stdin.close()
        assert running.wait(PATIENCE) == 0


@pytest.mark.parametrize(
    "bomb",
    [pytest.param(bomb, marks=pytest.mark.long) if bomb.name in LONG else bomb for bomb in BOMBS],
    ids=lambda bomb: f"{bomb.ending[1:]}: {bomb.name}",
)
def test_a_bomb_is_refused_soon_and_in_little_memory(bomb: Bomb, tmp_path: Path, program: subprocess.Popen[str]):
    path = tmp_path / f"bomb{bomb.ending}"
    assert program.stdin is not None
    assert program.stdout is not None
    try:
        program.stdin.write(json.dumps([BOMBS.index(bomb), str(path)]) + "\n")
        program.stdin.flush()
        reported = json.loads(program.stdout.readline())
    finally:
        path.unlink(missing_ok=True)
    assert isinstance(reported, list), reported
    refusal, seconds, reference, megabytes = reported
    assert refusal
    assert not refusal.startswith("HOLE")
    assert "\n" not in refusal
    assert len(refusal) < 1000
    assert seconds < SECONDS * max(1.0, reference / REFERENCE)
    assert megabytes < MEGABYTES


def made(name: str) -> bytes:
    (bomb,) = (bomb for bomb in BOMBS if bomb.name == name)
    return bomb.make()


def chunks_of(file: bytes) -> Iterator[tuple[int, bytes]]:
    """Declared size and packed data of each chunk of an MCAP file: records are a kind, a length and a body."""
    assert file[:8] == b"\x89MCAP0\r\n"
    at = 8
    while at < len(file):
        kind, length = struct.unpack_from("<BQ", file, at)
        at += 9
        assert at + length <= len(file), "no record is cut off"
        if kind == 6:
            (declared,) = struct.unpack_from("<Q", file, at + 16)
            (name,) = struct.unpack_from("<I", file, at + 28)
            assert file[at + 32 : at + 32 + name] == b"zstd"
            yield declared, file[at + 32 + name + 8 : at + length]
        at += length


def unpacked(packed: bytes, most: int) -> bytes:
    with zstandard.ZstdDecompressor(max_window_size=2**31).stream_reader(packed) as stream:
        return stream.read(most)


@pytest.mark.parametrize(("name", "size"), [("a file of 200 MB", 200), ("one line of 50 MB", 50)])
def test_a_large_bomb_is_as_large_as_its_name_says(name: str, size: int) -> None:
    assert size * 2**20 <= len(made(name)) < 1.1 * size * 2**20


@pytest.mark.parametrize(
    ("name", "declared"), [("a chunk of 2 GB in 65 KB", 2**31), ("a chunk that says less than it holds", 1000)]
)
def test_a_packed_bomb_holds_two_gigabytes_whatever_it_declares(name: str, declared: int) -> None:
    file = made(name)
    ((size, packed),) = chunks_of(file)
    assert size == declared
    assert len(file) < 100_000
    parameters = zstandard.get_frame_parameters(packed)
    assert parameters.content_size == 2**31
    assert len(unpacked(packed, 64 << 20)) == 64 << 20


def test_each_of_400_chunks_is_allowed_and_holds_what_it_declares() -> None:
    found = list(chunks_of(made("400 chunks of 8 MB")))
    assert len(found) > 400
    assert len(set(found)) == 1
    declared, packed = found[0]
    assert 0.99 * 8 * 2**20 < declared == len(unpacked(packed, 9 << 20)) <= 8 * 2**20


@pytest.mark.parametrize(("name", "kind"), [("a million empty records", 0), ("a million private records", 0x80)])
def test_a_bomb_of_records_has_about_a_million_of_them(name: str, kind: int) -> None:
    """Nine bytes each, the file packed as a whole."""
    whole = unpacked(made(name), 1 << 30)
    assert whole[8:17] == bytes([kind, *[0] * 8])
    assert 700_000 <= (len(whole) - 8) / 9.0 <= 1_300_000
