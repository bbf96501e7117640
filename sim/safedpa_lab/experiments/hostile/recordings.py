"""A recording of a whole drive in which single fields of messages say what no program of ours would have written.

Mutated bytes seldom get past the checks of a file or of a message; here each message is well formed, and one to three
of its fields are of another type, length, sign or size, or point elsewhere.
"""

from __future__ import annotations

import json
import random
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import msgpack

from safedpa.errors import SafedpaError
from safedpa.records import load_run
from safedpa.records.readers.mcap import read_payloads
from safedpa.robots.car.system import CAR
from safedpa_lab.experiments.hostile.targets import Target

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


def written(messages: Sequence[Recorded], path: Path) -> None:
    """A recording of these messages, as the recorder writes one."""
    from mcap.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file, chunk_size=1 << 16)
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
    from safedpa.replay.gaps import gaps_of
    from safedpa.replay.replay import replay
    from safedpa.replay.report import document_of, lines_of
    from safedpa.replay.setups import complete_setups
    from safedpa.replay.tape import read_tape

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
