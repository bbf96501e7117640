"""What a benchmark found: rows of entries, each with its figures, the targets, and how cost grows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, final


@final
@dataclass(frozen=True)
class Effort:
    """How much is measured: ``quick`` to see that everything works, ``full`` where nothing is scaled or left out."""

    quick: bool = False
    full: bool = False
    interpreters: tuple[str, ...] = ()
    """Pythons in which peers are looked for, before this one."""
    recordings: Path | None = None
    """Folder with recordings of real robots; None: what needs them is left out, and says so."""

    def of(self, quick: Any, usual: Any, full: Any = None) -> Any:
        """The one that belongs to this effort; ``full`` is as ``usual`` unless given."""
        if self.quick:
            return quick
        return usual if full is None or not self.full else full


@final
@dataclass(frozen=True)
class Entry:
    """One program on one problem."""

    name: str
    figures: Mapping[str, float] = field(default_factory=dict)
    unit: str = "us"
    processor: Mapping[str, float] = field(default_factory=dict)
    """The same figures in processor time of all threads."""
    problem: str = ""
    """Entries are compared with entries of the same problem."""
    note: str = ""
    """What it does not do, or how it was measured."""
    missing: str = ""
    """Why there are no figures."""
    more: Mapping[str, Any] = field(default_factory=dict)


@final
@dataclass(frozen=True)
class Floor:
    """What a part costs that nothing can do without, in the unit of the target that it stands next to."""

    name: str
    value: float


@final
@dataclass(frozen=True)
class Target:
    """What was asked, and what came out."""

    what: str
    wanted: float
    got: float
    unit: str
    better: Literal["less", "more"] = "less"
    floor: Floor | None = None

    @property
    def reached(self) -> bool:
        """Whether it is at least as good."""
        return self._good(self.got)

    @property
    def forbidden(self) -> bool:
        """Whether the floor alone already misses it."""
        return self.floor is not None and not self._good(self.floor.value)

    def _good(self, value: float) -> bool:
        return value <= self.wanted if self.better == "less" else value >= self.wanted


@final
@dataclass(frozen=True)
class Curve:
    """How cost grows: one series of numbers a name, over ``x``."""

    name: str
    x_name: str
    y_name: str
    x: tuple[float, ...]
    series: Mapping[str, tuple[float | None, ...]]


@final
@dataclass(frozen=True)
class Row:
    """One line of the table: what is done, by this project and by its peers."""

    name: str
    work: str
    figure: str
    """Which figure is compared: ``p50``, ``seconds``, ``per_second``."""
    ours: tuple[Entry, ...]
    peers: tuple[Entry, ...] = ()
    targets: tuple[Target, ...] = ()
    curves: tuple[Curve, ...] = ()
    better: Literal["less", "more"] = "less"
    notes: tuple[str, ...] = ()

    def ratio(self, peer: Entry) -> float | None:
        """How many times better this project's first entry on the same problem is; None where there is none."""
        own = next((entry for entry in self.ours if entry.problem == peer.problem), None)
        if own is None or not peer.figures.get(self.figure) or not own.figures.get(self.figure):
            return None
        times = peer.figures[self.figure] / own.figures[self.figure]
        return times if self.better == "less" else 1.0 / times

    def as_document(self) -> dict[str, Any]:
        """Plain numbers, strings and lists, with the ratios next to the peers and whether the targets were reached."""
        document = asdict(self)
        for entry, peer in zip(document["peers"], self.peers, strict=True):
            ratio = self.ratio(peer)
            entry["ratio"] = None if ratio is None else round(ratio, 3)
        for entry, target in zip(document["targets"], self.targets, strict=True):
            entry["reached"], entry["forbidden"] = target.reached, target.forbidden
        return document


def microseconds(name: str, times: Mapping[str, Any], problem: str = "", note: str = "", **more: Any) -> Entry:
    """An entry of what ``timing.timed`` found."""
    return Entry(
        name,
        figures=times["wall"],
        processor=times["processor"],
        problem=problem,
        note=note,
        more={"calls": times["calls"], **more},
    )


def steps(name: str, found: Mapping[str, float], note: str = "", problem: str = "") -> Entry:
    """An entry of what ``timing.rate`` found."""
    figures = {name: found[name] for name in ("per_second", "best_per_second")}
    return Entry(name, figures, "steps/s", {"per_second": found["per_processor_second"]}, problem, note)


def missing(name: str, why: str, problem: str = "", note: str = "") -> Entry:
    """An entry of a peer that is not there."""
    return Entry(name, problem=problem, note=note, missing=why)
