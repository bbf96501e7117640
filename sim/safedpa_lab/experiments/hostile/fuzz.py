"""Runs mutated inputs against every target in turn, and against a loop that drives, until the time is over.

The loop is a car and its three services over a bus in memory, to which someone with every key sends mutated messages.
"""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, final

from safedpa.bus import Bus, MemoryBroker, MemoryTransport, ServiceLoop
from safedpa.bus.messages.topics import TOPICS, key_of
from safedpa.dynamics import load_model
from safedpa.errors import InputError
from safedpa.records.readers.own_process import in_this_process
from safedpa.safety.defaults import settings_named
from safedpa_lab.experiments.common.drives import shipped_nodes
from safedpa_lab.experiments.hostile.targets import Target, messages, targets
from safedpa_sim.robots import CarRobot, Scene
from safedpa_sim.robots.fleet.loop import FleetLoop

_TOKENS = (
    b"\x00", b"\xff" * 4, b"\xff" * 8, b"\x7f\xff\xff\xff", b"\x80\x00\x00\x00", b"\xdd\xff\xff\xff\xff", b"\xc1",
    b"nan", b"inf", b"-1e309", b"9" * 400, b"[" * 60, b"{" * 60, b"." * 60, b'"""', b"'''", b"\\u202e", b"\x1b[2J",
    b"../" * 8, b"%2e%2e%2f", b"\r\n", b"\r\nX: y", b"\xed\xa0\x80", b"\xef\xbb\xbf", b",", b";", b"\n", b"=", b"#",
)  # fmt: skip
"""What breaks readers."""
_LARGEST = 1 << 18


def mutated(chance: random.Random, seeds: Sequence[bytes]) -> bytes:
    """One of the seeds, changed one to six times; the same chance gives the same bytes."""
    data = bytearray(chance.choice(seeds))
    for _ in range(chance.randint(1, 6)):
        at = chance.randrange(len(data) + 1)
        kind = chance.randrange(7)
        if kind == 0 and data:
            data[at % len(data)] ^= 1 << chance.randrange(8)
        elif kind == 1:
            data[at:at] = chance.choice(_TOKENS)
        elif kind == 2:
            del data[at : at + chance.randint(1, 64)]
        elif kind == 3:
            other = chance.choice(seeds)
            begin = chance.randrange(len(other) + 1)
            data[at : at + 32] = other[begin : begin + chance.randint(1, 256)]
        elif kind == 4:
            piece = bytes(data[at : at + chance.randint(1, 32)])
            data[at:at] = piece * chance.randint(2, 200)
        elif kind == 5:
            data[at : at + 8] = chance.randbytes(8)
        else:
            del data[at:]
    return bytes(data[:_LARGEST])


_TURN_SECONDS = 0.0025
_MESSAGES = 4
"""Hostile ones a turn."""
_NAMES = ("r1", "r2", "\x1b[2J", "x" * 200, "-", "+")


@final
class DrivenLoop:
    """Turned by hand; its clock moves as it is turned."""

    def __init__(self) -> None:
        self._now = 100.0
        self._broker = MemoryBroker()
        model = load_model("car")
        nodes = shipped_nodes(model, settings_named("car"))
        self._services = [ServiceLoop(node, self._bus(), clock=self._clock) for node in nodes]
        car = CarRobot(Scene.random(0, "none"), 0.05, lockstep=False, epoch=1, wall_clock=self._clock)
        self._robots = FleetLoop({"r1": car}, self._bus(), clock=self._clock)
        self._stranger = MemoryTransport(self._broker)
        self._seeds = tuple(payload for _, payload in messages())
        for _ in range(400):
            self._turn()

    @property
    def refused(self) -> int:
        """Messages that no service took."""
        return sum(loop._unserved.refused for loop in self._services)

    def attacked(self, chance: random.Random) -> tuple[float, str]:
        """s of processor time that the slowest service took for one turn under attack, and what it raised."""
        for _ in range(_MESSAGES):
            topic = chance.choice(list(TOPICS.values()))
            key = f"safedpa/test/{chance.choice(_NAMES)}/{topic.name}" + ("/policy" if topic.per_service else "")
            if chance.random() < 0.7:
                key = key_of("test", "r1", topic, "policy")
            self._stranger.put(key, mutated(chance, self._seeds), never_drop=topic.delivery == "all")
        worst, hole = 0.0, ""
        self._now += _TURN_SECONDS
        self._robots.step()
        for service in self._services:
            began = time.thread_time()
            try:
                service.turn(0.0)
            except Exception as error:  # noqa: BLE001  this is what is looked for
                hole = f"{type(error).__name__}: {error}"[:200]
            worst = max(worst, time.thread_time() - began)
        return worst, hole

    def _turn(self) -> None:
        self._now += _TURN_SECONDS
        self._robots.step()
        for service in self._services:
            service.turn(0.0)

    def _clock(self) -> float:
        return self._now

    def _bus(self) -> Bus:
        return Bus(MemoryTransport(self._broker), "test")


MOST_STEP_SECONDS = 0.05
"""For one turn of the loop while it is attacked."""
_AT_A_TIME = 20


@dataclass
class Tally:
    """The results of one target."""

    name: str
    inputs: int = 0
    refused: int = 0
    worst_seconds: float = 0.0
    """Processor time of one input."""
    holes: list[str] = field(default_factory=list)
    """Descriptions of unexpected results."""

    def as_row(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "target": self.name,
            "inputs": self.inputs,
            "refused": self.refused,
            "worst_ms": round(1e3 * self.worst_seconds, 3),
            "holes": self.holes,
        }


def fuzz(
    seconds: float,
    seed: int,
    out: Path | None = None,
    report_progress: Callable[[float], None] = lambda share: None,
    further: Sequence[Target] = (),
) -> list[Tally]:
    """Tallies of every target after ``seconds``; what opened a hole is written to ``out``. Repeats with its seed, but
    for how far it gets."""
    chance = random.Random(seed)
    with ExitStack() as stack:
        pairs = [(target, Tally(target.name)) for target in (*stack.enter_context(targets()), *further)]
        loop = DrivenLoop()
        driven = Tally("loop that drives")
        begun = time.monotonic()
        while time.monotonic() - begun < seconds:
            for target, tally in pairs:
                for _ in range(_AT_A_TIME):
                    _try(target, tally, mutated(chance, target.seeds), out)
            _drive(loop, driven, chance)
            report_progress(min(1.0, (time.monotonic() - begun) / seconds))
    return [*(tally for _, tally in pairs), driven]


def _try(target: Target, tally: Tally, data: bytes, out: Path | None) -> None:
    began, hole = time.process_time(), ""
    try:
        with in_this_process():
            target.read(data)
    except InputError as error:
        tally.refused += 1
        if "\n" in str(error):
            hole = "a refusal of more than one line"
    except Exception as error:  # noqa: BLE001  this is what is looked for
        hole = f"{type(error).__name__}: {error}"[:200]
    spent = time.process_time() - began
    tally.inputs += 1
    tally.worst_seconds = max(tally.worst_seconds, spent)
    if spent > target.most_seconds:
        hole = hole or f"took {spent:.2f} s, wanted at most {target.most_seconds:g} s"
    if hole:
        _note(tally, hole, data, out)


def _note(tally: Tally, hole: str, data: bytes, out: Path | None) -> None:
    if hole in tally.holes:
        return
    tally.holes.append(hole)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        (out / f"{tally.name.replace(' ', '_').replace('.', '')}-{len(tally.holes):03d}.bin").write_bytes(data)


def _drive(loop: DrivenLoop, tally: Tally, chance: random.Random) -> None:
    for _ in range(_AT_A_TIME):
        spent, raised = loop.attacked(chance)
        tally.inputs += 1
        tally.worst_seconds = max(tally.worst_seconds, spent)
        hole = raised or (f"a turn took {1e3 * spent:.0f} ms" if spent > MOST_STEP_SECONDS else "")
        if hole and hole not in tally.holes:
            tally.holes.append(hole)
    tally.refused = loop.refused
