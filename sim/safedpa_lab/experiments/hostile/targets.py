"""What is attacked: every reader of foreign bytes, each with good examples to begin with."""

from __future__ import annotations

import io
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from safedpa.bus import HealthMessage, ModelMessage, StateMessage
from safedpa.bus.messages.codec import decode, encode
from safedpa.bus.messages.requests import Answer, Request
from safedpa.bus.messages.topics import topic_of
from safedpa.bus.transport.batching import pack_bundle, unpack_bundle
from safedpa.dynamics import load_model, parse_model, write_model
from safedpa.dynamics.model_offer import offered_model
from safedpa.networks import load_weights
from safedpa.records import load_column_map, load_run
from safedpa.records.column_map.file import parse_column_map, shipped_column_maps
from safedpa.robots.car.system import CAR
from safedpa.safety.defaults import margin_for
from safedpa.safety.margins.calibration import margin_from_text, margin_text
from safedpa.safety.settings import parse_settings


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


def _decoded(kind: type[Any], data: bytes) -> object:
    return decode(kind, data)


def _codecs() -> Iterator[Target]:
    kinds = messages()
    for kind, payload in kinds:
        others = tuple(other for _, other in kinds)
        yield Target(f"message {kind.__name__}", (payload, *others), partial(_decoded, kind), 0.05)
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
    from mcap.writer import Writer

    path = folder / "seed.mcap"
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=4096)
        writer.start()
        channel = writer.register_channel("safedpa/fleet/r1/state", "msgpack", schema_id=0)
        for tick in range(60):
            writer.add_message(channel, tick * 50_000_000, encode(state_at(tick)), tick * 50_000_000)
        writer.finish()
    return path.read_bytes()


def _weights() -> bytes:
    from safedpa.dynamics import shipped_models

    path = next(path for path in shipped_models().values() if path.with_suffix(".safetensors").exists())
    return path.with_suffix(".safetensors").read_bytes()[: 1 << 17]
