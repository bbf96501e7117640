"""Runs mutated inputs against every target in turn, and against a loop that drives, until the time is over."""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from safedpa.errors import InputError
from safedpa_lab.experiments.hostile.driven import DrivenLoop
from safedpa_lab.experiments.hostile.mutations import mutated
from safedpa_lab.experiments.hostile.targets import Target, targets

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
    for spent, raised in _turns(loop, chance):
        tally.inputs += 1
        tally.worst_seconds = max(tally.worst_seconds, spent)
        hole = raised or (f"a turn took {1e3 * spent:.0f} ms" if spent > MOST_STEP_SECONDS else "")
        if hole and hole not in tally.holes:
            tally.holes.append(hole)
    tally.refused = loop.refused


def _turns(loop: DrivenLoop, chance: random.Random) -> Iterator[tuple[float, str]]:
    for _ in range(_AT_A_TIME):
        yield loop.attacked(chance)
