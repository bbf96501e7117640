"""What is attacked: every reader of foreign bytes, the pages' handlers, and recordings whose fields say odd things.

Mutated bytes seldom get past the checks of a file or of a message. So in a recording of a whole drive each message is
well formed, and one to three of its fields are of another type, length, sign or size, or point elsewhere.
"""

from __future__ import annotations

import asyncio
import io
import json
import random
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import msgpack
import numpy as np

from safedpa.bus import HealthMessage, ModelMessage, StateMessage
from safedpa.bus.messages.codec import decode, encode, pack_bundle, unpack_bundle
from safedpa.bus.messages.requests import Answer, Request
from safedpa.bus.messages.topics import topic_of
from safedpa.dynamics import load_model, parse_model, write_model
from safedpa.dynamics.model_offer import offered_model
from safedpa.errors import SafedpaError
from safedpa.networks import load_weights
from safedpa.records import load_column_map, load_run
from safedpa.records.column_map.file import parse_column_map, shipped_column_maps
from safedpa.records.readers.mcap import read_payloads
from safedpa.robots.car.system import CAR
from safedpa.safety.defaults import margin_for
from safedpa.safety.margins.calibration import margin_from_text, margin_text
from safedpa.safety.settings import parse_settings
from safedpa_services.router.refusals import Refusals
from safedpa_services.web.guard import Guard
from safedpa_services.web.page_options import PageServerOptions
from safedpa_services.web.upload_store import FileStore


@dataclass(frozen=True)
class Target:
    """One reader. It may take the bytes, or refuse them by InputError; nothing else, and not for longer."""

    name: str
    seeds: tuple[bytes, ...]
    read: Callable[[bytes], object]
    most_seconds: float = 1.0
    """Of processor time, for one input."""


def state_at(tick: int) -> StateMessage:
    """Of a car in an empty field."""
    return StateMessage(
        epoch=1,
        tick=tick,
        robot_time=0.05 * tick,
        publish_time=0.0,
        values=(0.0, 0.0, 0.0, 0.0),
        applied=(0.0, 0.0),
        applied_by="filter",
        period=0.05,
        lockstep=False,
        goal=(1.0, 1.0),
        obstacles=(),
        field=(-4.0, 4.0, -4.0, 4.0),
        footprint=(0.1, 0.4, 0.1),
    )


def messages() -> tuple[tuple[type[Any], bytes], ...]:
    """Good messages of some kinds, as they travel."""
    model = write_model(load_model("car"))
    stamp: dict[str, Any] = {"epoch": 1, "tick": 1, "robot_time": 0.05, "publish_time": 0.0}
    offer = ModelMessage(**stamp, step="offer", change=1, fingerprint="a" * 12, replaces="", document=model)
    health = HealthMessage(**stamp, service="policy", pid=1, state="running", detail="well")
    answer = Answer(ok=True, sentence="well", document=model)
    asked = Request(do="accept", effect="payload", model="a" * 12, finding=1, who="alice")
    return tuple((type(item), encode(item)) for item in (state_at(1), offer, health, answer, asked))


@contextmanager
def targets() -> Iterator[tuple[Target, ...]]:
    """All of them; files go to a folder that is removed."""
    with tempfile.TemporaryDirectory(prefix="safedpa-hostile-") as name:
        yield (*_codecs(), *_texts(), *_files(Path(name)))


def _codecs() -> Iterator[Target]:
    kinds = messages()
    for kind, payload in kinds:
        others = tuple(other for _, other in kinds)
        yield Target(f"message {kind.__name__}", (payload, *others), partial(decode, kind), 0.05)
    state = encode(state_at(1))
    yield Target("bundle", (pack_bundle([("r1", state), ("r2", state)]),), unpack_bundle, 0.05)
    keys = (b"safedpa/fleet/r1/state", b"safedpa/fleet/-/health/policy", b"safedpa/fleet/+/action")
    yield Target("key", keys, lambda data: topic_of(data.decode("utf-8", "replace")), 0.05)


def _text(read: Callable[[str], object]) -> Callable[[bytes], object]:
    return lambda data: read(data.decode("utf-8", "replace"))


def _texts() -> Iterator[Target]:
    car = load_model("car")
    model = write_model(car).encode() + b'\n[[effects]]\nname = "payload"\nmass_ratio = { value = 0.3, free = true }\n'
    yield Target("model", (model,), _text(parse_model))
    offer = {"epoch": 1, "tick": 0, "robot_time": 0.0, "publish_time": 0.0, "step": "offer", "change": 1}

    def offered(text: str) -> object:
        return offered_model(ModelMessage(**offer, fingerprint="", replaces="", document=text), car)  # type: ignore[arg-type]

    yield Target("offered model", (model,), _text(offered), 0.05)
    margin = margin_for(car)
    assert margin is not None
    yield Target("margin", (margin_text(margin).encode(),), _text(margin_from_text), 0.05)
    yield Target("margin file", (margin.write().encode(),), _text(type(margin).parse))
    maps = tuple(path.read_bytes() for path in shipped_column_maps().values())
    yield Target("column map", maps, _text(parse_column_map))
    yield Target("settings", (b"format = 2\neta = 0.4\n[epsilon]\nobstacle = 0.05\n",), _text(parse_settings))


def _files(folder: Path) -> Iterator[Target]:
    load_column_map(next(iter(shipped_column_maps())))  # imports what it needs before time counts

    def of(ending: str, read: Callable[[Path], object]) -> Callable[[bytes], object]:
        path = folder / f"input{ending}"

        def reading(data: bytes) -> object:
            path.write_bytes(data)
            return read(path)

        return reading

    def run(path: Path) -> object:
        return load_run(path, CAR)

    yield Target("recording .csv", (_csv(),), of(".csv", run))
    yield Target("recording .parquet", (_parquet(),), of(".parquet", run))
    yield Target("recording .mcap", (_mcap(folder),), of(".mcap", run))
    yield Target("weights", (_weights(),), of(".safetensors", load_weights))


_COLUMNS = ("t", "x", "y", "yaw", "speed", "target_speed", "steer")


def _rows() -> np.ndarray[Any, np.dtype[np.float64]]:
    t = 0.05 * np.arange(60)
    return np.column_stack([t, t, 0 * t, 0 * t, 1 + 0 * t, 1 + 0 * t, 0 * t])


def _csv() -> bytes:
    lines = [",".join(_COLUMNS), *(",".join(f"{value:.3f}" for value in row) for row in _rows())]
    return ("\n".join(lines) + "\n").encode()


def _parquet() -> bytes:
    import pyarrow
    from pyarrow import parquet

    sink = io.BytesIO()
    parquet.write_table(pyarrow.table(dict(zip(_COLUMNS, _rows().T, strict=True))), sink)
    return sink.getvalue()


def _mcap(folder: Path) -> bytes:
    path = folder / "seed.mcap"
    key = "safedpa/fleet/r1/state"
    written([(key, tick * 50_000_000, encode(state_at(tick))) for tick in range(60)], path, 4096)
    return path.read_bytes()


def _weights() -> bytes:
    from safedpa.dynamics import shipped_models

    path = next(path for path in shipped_models().values() if path.with_suffix(".safetensors").exists())
    return path.with_suffix(".safetensors").read_bytes()[: 1 << 17]


_TOKEN = "a-token-that-cannot-be-guessed"
_GOOD = (
    b"GET / HTTP/1.1\nHost: 127.0.0.1:8080\nCookie: safedpa_8080=x\n",
    b"GET /?token=x HTTP/1.1\nHost: localhost\nSec-Fetch-Site: none\n",
    b"POST /_nicegui/client/a/upload/1 HTTP/1.1\nHost: 127.0.0.1:8080\nOrigin: http://127.0.0.1:8080\n"
    b"Content-Length: 12\nCookie: a=b; safedpa_8080=\n",
    b"WS /_nicegui_ws/socket.io/ HTTP/1.1\nHost: [::1]:8080\nOrigin: null\nSec-Fetch-Site: cross-site\n",
)
_LINES = (
    b"2026-01-01T00:00:00Z TRACE net-0 ThreadId(04) zenoh::net::routing::interceptor::access_control: aa on x is "
    b"unauthorized to Put (ingress) on safedpa/f/r1/action",
    b"2026-01-01T00:00:00Z TRACE net-0 ThreadId(04) zenoh::net::routing::interceptor: Msg intercepted!",
    b"2026-01-01T00:00:00Z WARN net-0 ThreadId(04) zenoh_link_tls::unicast: tls handshake eof. Hint: more",
)


@contextmanager
def page_targets() -> Iterator[tuple[Target, ...]]:
    """A guard with a page behind it, a shelf with files around it, the reader of the router's log."""
    with tempfile.TemporaryDirectory(prefix="safedpa-hostile-pages-") as name:
        yield (_guard(), _upload_store(Path(name).resolve()), _log())


def _guard() -> Target:
    async def page(scope: Any, receive: Any, send: Any) -> None:
        raise AssertionError("a request without the token got through")

    guard = Guard(page, PageServerOptions("127.0.0.1", 8080, token=_TOKEN))

    async def receive() -> dict[str, Any]:
        return {"type": "http.request", "body": b"", "more_body": False}

    async def send(message: Any) -> None:
        if message["type"] == "http.response.start":
            for _, value in message["headers"]:
                if b"\n" in value or b"\r" in value:
                    raise AssertionError("a header of two lines")

    def read(data: bytes) -> None:
        first, *lines = data.split(b"\n")
        phrase = first.decode("latin-1").split(" ")
        path, _, query = (phrase[1] if len(phrase) > 1 else "/").partition("?")
        scope = {
            "type": "websocket" if phrase[0] == "WS" else "http",
            "method": phrase[0],
            "path": path,
            "query_string": query.encode("latin-1"),
            "headers": [(n.strip().lower(), v.strip()) for n, _, v in (line.partition(b":") for line in lines) if n],
            "client": ("127.0.0.1", 1),
        }
        asyncio.run(guard(scope, receive, send))

    return Target("page's guard", _GOOD, read, 0.1)


def _upload_store(folder: Path) -> Target:
    named, outside = folder / "named", folder / "outside"
    for place in (named, outside):
        place.mkdir()
        (place / "run.csv").write_text("t,x\n0,1\n", encoding="utf-8")
    (named / "link.csv").symlink_to(outside / "run.csv")
    (named / "way").symlink_to(outside)
    upload_store = FileStore([named])
    names = ("named/run.csv", "named/../outside/run.csv", "named/way/run.csv", "named/*.csv", "outside/run.csv")
    seeds = tuple(f"{folder}/{name}".encode() for name in names)

    def read(data: bytes) -> None:
        for found in upload_store.recordings(data.decode("utf-8", "replace").splitlines()):
            if not Path(found).resolve().is_relative_to(named):
                raise AssertionError(f"{found} was opened")

    return Target("page's files", seeds, read, 0.5)


def _log() -> Target:
    refusals = Refusals()
    return Target("router's log", _LINES, lambda data: refusals.hear(data.decode("utf-8", "replace")), 0.05)


Recorded = tuple[str, int, bytes]
"""Key, ns, payload."""
_SECONDS = 2.0
_VALUES: tuple[Any, ...] = (
    None, True, -1, 0, 1, 7, (1 << 53) + 1, (1 << 63) - 1, -0.5, 1e-300, 1e300, float("nan"), "", "x", "x" * 5000,
    "\x1b[2J", "../../etc/passwd", "/dev/zero", "\x00", b"\xff\xfe", [], [1.0], [[]], [[1.0]], [[1.0, 2.0]] * 40,
    [[0.0, 1e300]] * 4, ["a"], {}, {"a": 1}, {"a": {1: 2}}, {"a": {b"\xff": []}}, {"a": [[[[[[[[1]]]]]]]]},
)  # fmt: skip


def misspoken(chance: random.Random, payload: bytes) -> bytes:
    """The message with one to three of its fields changed, left out, or an unknown one added."""
    table = msgpack.unpackb(payload, strict_map_key=False)
    for _ in range(chance.randint(1, 3)):
        name = chance.choice(list(table) or ["x"])
        kind = chance.randrange(8)
        if kind == 0:
            table.pop(name, None)
        elif kind == 1:
            table[f"of a later version {chance.randrange(3)}"] = chance.choice(_VALUES)
        else:
            table[name] = _other(chance, table.get(name))
    packed: bytes = msgpack.packb(table)
    return packed


def _other(chance: random.Random, value: Any) -> Any:
    """Another value in place of one: as hostile as can be, or much like it."""
    if isinstance(value, list) and value and chance.random() < 0.6:
        changed = list(value)
        at = chance.randrange(len(changed))
        kind = chance.randrange(4)
        if kind == 0:
            del changed[at]
        elif kind == 1:
            changed.insert(at, changed[at])
        else:
            changed[at] = _other(chance, changed[at])
        return changed
    if isinstance(value, str) and value.startswith("{") and chance.random() < 0.8:
        return _other_json(chance, value)
    if isinstance(value, str) and len(value) > 1 and chance.random() < 0.5:
        at = chance.randrange(len(value))
        return value[:at] + chance.choice(("", "=", "[[", "9" * 30, "\n", "-", "e400", '"')) + value[at + 1 :]
    if isinstance(value, int | float) and not isinstance(value, bool) and chance.random() < 0.5:
        return chance.choice((-value, value + 1, value * 1e6, value / 3.0, float(value), str(value)))
    return chance.choice(_VALUES)


def _other_json(chance: random.Random, text: str) -> str:
    try:
        table = json.loads(text)
    except ValueError:
        return text[: len(text) // 2]
    name = chance.choice(list(table) or ["x"])
    notice = [value for value in _VALUES if not isinstance(value, bytes | dict)]
    table[name] = chance.choice((*notice, {"a": 1}))
    return json.dumps(table)


def written(messages: Sequence[Recorded], path: Path, chunk: int = 1 << 16) -> None:
    """A recording of these messages, as the recorder writes one."""
    from mcap.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file, chunk_size=chunk)
        writer.start()
        channels: dict[str, int] = {}
        for key, at, payload in messages:
            if key not in channels:
                channels[key] = writer.register_channel(key, "msgpack", schema_id=0)
            writer.add_message(channels[key], at, payload, at)
        writer.finish()


def recording_targets(folder: Path, seed: int = 0) -> Iterator[Target]:
    """Reading, comparing and replaying such a recording. Drives for two seconds first; raises SafedpaError if not."""
    messages = recorded_drive(folder)
    path = folder / "misspoken.mcap"

    def reading(then: Callable[[Path], object]) -> Callable[[bytes], object]:
        def read(data: bytes) -> object:
            """The bytes decide which messages are changed, and how."""
            chance = random.Random(data + bytes([seed & 255]))
            changed = list(messages)
            for _ in range(chance.choice((1, 1, 2, 8))):
                group = chance.choice(sorted({key for key, _, _ in changed}))
                at = chance.choice([index for index, entry in enumerate(changed) if entry[0] == group])
                changed[at] = (*changed[at][:2], misspoken(chance, changed[at][2]))
            written(changed, path)
            return then(path)

        return read

    seeds = (bytes(range(16)),)
    yield Target("recorded drive: compared", seeds, reading(lambda path: load_run(path, CAR)), 2.0)
    yield Target("recorded drive: replayed", seeds, reading(replayed), 4.0)
    yield Target("recorded drive: driven again", seeds, reading(driven_again), 6.0)


def replayed(path: Path) -> object:
    """As ``safedpa replay`` does it, up to what is printed."""
    from safedpa.replay.replay import replay
    from safedpa.replay.report import document_of, lines_of
    from safedpa.replay.setups import complete_setups
    from safedpa.replay.tape import gaps_of, read_tape

    tape = read_tape([path])
    assumed = complete_setups(tape)
    found, gaps = replay(tape), gaps_of(tape)
    return json.dumps(document_of(tape, found, gaps, assumed)), list(lines_of(tape, found, gaps, assumed))


def driven_again(path: Path) -> object:
    """As ``safedpa replay --closed-loop`` does it."""
    from safedpa.replay.report import what_if_document
    from safedpa.replay.setups import complete_setups
    from safedpa.replay.tape import read_tape
    from safedpa.replay.what_if import WhatIfChange, summary_of, what_if
    from safedpa_sim.recorded_drive import drive_again

    tape, change = read_tape([path]), WhatIfChange(filtered=True)
    complete_setups(tape)
    decisions = what_if(tape, change)
    driven = drive_again(tape, change)
    return json.dumps(what_if_document(summary_of(decisions), decisions, "the filter on")), json.dumps(driven)


def recorded_drive(folder: Path) -> list[Recorded]:
    """Messages of a car's two seconds in lockstep. Raises SafedpaError when it does not drive."""
    command = [sys.executable, "-m", "safedpa_services", "up", "--headless", "--no-diagnosis", "--json", "--lockstep"]
    done = subprocess.run(
        [*command, "--seconds", repr(_SECONDS), "--out", str(folder / "drive")],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode != 0:
        raise SafedpaError(f"safedpa up: {done.stderr.strip()[-300:]}")
    path = Path(json.loads(done.stdout)["recording"])
    return [(key, at, payload) for key, at, _, payload in read_payloads(path)]
