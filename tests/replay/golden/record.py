"""Records the golden runs again: ``python tests/replay/golden/record.py --why "..." [NAME ...]``; about a minute.

To be done on purpose only: when services shall decide otherwise than before. Each one's former recording is replayed by
the program as it is now, and what differs, field by field, is written with the reason into ``changes.json`` next to it;
a recording whose sum does not stand there as the newest fails its test.
"""

import argparse
import datetime
import hashlib
import json
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

from safedpa.bus import SETUP, SetupMessage, decode, encode
from safedpa.records.readers.mcap import read_payloads
from safedpa.records.writers.mcap import schema_of
from safedpa.replay.replay import replay
from safedpa.replay.tape import read_tape

HERE = Path(__file__).parent
RUNS: dict[str, tuple[tuple[str, ...], dict[str, float]]] = {
    "car_box": (("--lockstep", "--load", "box", "--seconds", "6"), {}),
    "car_killed": (("--load", "chair", "--seconds", "10"), {"policy": 3.0, "adaptation": 5.0, "safety_filter": 7.0}),
    "car_learned": (("--lockstep", "--model", "car_learned", "--load", "box", "--seconds", "3"), {}),
    "pendulum": (("--lockstep", "--robot", "pendulum", "--wind", "2", "--seconds", "1"), {}),
}
"""Options of ``safedpa up``, and which services are killed how many seconds after the robot's start."""
_LEFT_OUT = ("health/", "finding", "setup/recorder")
"""Keys not needed for a replay."""
_OPTIONS = ("robot", "load", "seed", "rate", "lockstep", "change", "change_after", "task", "wind", "wind_direction")
_OPTIONS += ("payload", "dry_friction", "model", "controller", "settings", "off")
"""Options that decide something; the others name files and ports."""
_CHUNK_BYTES = 4 * 1024 * 1024


CHANGES = HERE / "changes.json"
"""By run, the oldest first: when it was recorded, why, what its predecessor did otherwise then, and its sum."""


def main(arguments: list[str]) -> None:
    """Records the runs named, or all."""
    parser = argparse.ArgumentParser(description="Records golden runs again.")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"{', '.join(RUNS)}; default: all")
    parser.add_argument("--why", required=True, help="why the services shall decide otherwise than before")
    given = parser.parse_args(arguments)
    if unknown := [name for name in given.names if name not in RUNS]:
        parser.error(f"{unknown[0]}: wanted one of {', '.join(RUNS)}")
    for name in given.names or list(RUNS):
        path = HERE / f"{name}.mcap"
        with tempfile.TemporaryDirectory() as folder:
            again = recorded(Path(folder), *RUNS[name])
            differing = differing_fields(path)
            compacted(again, path)
        retained(CHANGES, name, given.why, differing, path)


def differing_fields(path: Path) -> list[dict[str, Any]]:
    """Of a recording that this program replays: each field that comes out otherwise, in how many ticks, and how."""
    tape = read_tape([path])
    found: dict[tuple[str, str], dict[str, Any]] = {}
    for item in (item for part in replay(tape).services for item in part.differing):
        row = found.setdefault(
            (item.topic, item.field),
            {"field": f"{item.topic}.{item.field}", "ticks": 0, "of": len(tape.states), "first_tick": item.tick,
             "recorded": str(item.recorded)[:120], "replayed": str(item.replayed)[:120]},
        )  # fmt: skip
        row["ticks"] += 1
    return [found[key] for key in sorted(found)]


def retained(changes: Path, name: str, why: str, differing: list[dict[str, Any]], path: Path) -> None:
    """Writes down that a run was recorded again."""
    known: dict[str, list[dict[str, Any]]] = json.loads(changes.read_text("utf-8")) if changes.exists() else {}
    entry = {"date": datetime.date.today().isoformat(), "why": why, "differing": differing, "sha256": sum_of(path)}
    known.setdefault(name, []).append(entry)
    changes.write_text(json.dumps(known, indent=2) + "\n", encoding="utf-8")


def sum_of(path: Path) -> str:
    """SHA-256 of a recording."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def recorded(folder: Path, options: tuple[str, ...], kills: dict[str, float]) -> Path:
    """Drives and returns the recording."""
    command = [sys.executable, "-m", "safedpa_services", "up", "--headless", "--no-diagnosis", "--json"]
    process = subprocess.Popen([*command, "--out", str(folder), *options], stdout=subprocess.PIPE, text=True)
    begin = _began(process.pid)
    for service, after in kills.items():
        time.sleep(max(0.0, begin + after - time.monotonic()))
        _kill(process.pid, service)
    output, _ = process.communicate(timeout=120)
    summary = json.loads(output.splitlines()[-1])
    assert summary["recording_error"] is None, summary
    return Path(summary["recording"])


def _children(pid: int) -> Iterable[tuple[int, str]]:
    listed = subprocess.run(["ps", "-o", "pid=,args=", "--ppid", str(pid)], capture_output=True, text=True, check=False)
    for line in listed.stdout.splitlines():
        number, _, arguments = line.strip().partition(" ")
        yield int(number), arguments


def _began(pid: int) -> float:
    """When the robot's process was there."""
    give_up = time.monotonic() + 60.0
    while time.monotonic() < give_up:
        if any("safedpa_sim.robots" in arguments for _, arguments in _children(pid)):
            return time.monotonic()
        time.sleep(0.05)
    raise SystemExit("the robot was not started within a minute")


def _kill(pid: int, service: str) -> None:
    for child, arguments in _children(pid):
        if f"safedpa_services.{service} " in arguments:
            subprocess.run(["kill", f"-{int(signal.SIGKILL)}", str(child)], check=True)


def compacted(source: Path, target: Path) -> None:
    """The same messages without those that a replay does not need, in one chunk: a third of the size."""
    from mcap.writer import IndexType, Writer

    with target.open("wb") as file:
        writer = Writer(file, chunk_size=_CHUNK_BYTES, index_types=IndexType.NONE, repeat_schemas=False)
        writer.start(profile="safedpa")
        channels: dict[str, int] = {}
        schemas: dict[str, int] = {}
        for key, at, topic, payload in read_payloads(source):
            if any(f"/{part}" in key for part in _LEFT_OUT):
                continue
            if topic.name not in schemas:
                name = f"safedpa.{topic.message.__name__}"
                schemas[topic.name] = writer.register_schema(name, "jsonschema", schema_of(topic.message))
            if key not in channels:
                channels[key] = writer.register_channel(key, "msgpack", schemas[topic.name])
            writer.add_message(channels[key], at, _scrubbed(payload) if topic is SETUP else payload, at)
        writer.finish()


def _scrubbed(payload: bytes) -> bytes:
    """A setup with the options that decide something."""
    setup = decode(SetupMessage, payload)
    options = {name: value for name, value in json.loads(setup.options).items() if name in _OPTIONS}
    return encode(replace(setup, options=json.dumps(options, sort_keys=True)))


if __name__ == "__main__":
    main(sys.argv[1:])
