"""What of each robot's sources and zones counts: as its file says, and as a person ordered since.

Orders to perception on disk, so that perception that is started again still knows them.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Collection, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, final

from safedpa.bus.messages.requests import Answer, Request
from safedpa.disk import why_not_written, write_through
from safedpa.errors import InputError, did_you_mean
from safedpa.limits import parse_json, readable, text_of_file
from safedpa.perception.settings import PerceptionSettings
from safedpa.perception.zones import ActiveZones

__all__ = [
    "EVERY_SOURCE",
    "Ordered",
    "SensorOverrides",
    "load_overrides",
    "save_overrides",
]

Ordered = Mapping[str, Mapping[tuple[str, str], bool]]
"""By robot (``-``: each), then by ``source`` or ``zone`` and its name: whether it counts."""
EVERY_SOURCE: Final = ("source", "*")
_FORMAT = 1


def load_overrides(path: Path) -> tuple[dict[str, dict[tuple[str, str], bool]], str]:
    """The orders in a file, none where there is none; and why they cannot be read, or nothing.

    Orders that were lost might have closed a zone or left out a source that tells lies: where they cannot be read, no
    source of any robot counts until a person orders it on, and the filter brakes.
    """
    try:
        return _parsed(parse_json(text_of_file(path, "json_bytes"))), ""
    except FileNotFoundError:
        return {}, ""
    except (OSError, UnicodeDecodeError, InputError, AttributeError, ValueError, TypeError) as error:
        why = str(error) if isinstance(error, InputError) else type(error).__name__
        return {"-": {EVERY_SOURCE: False}}, f"the orders in {path} cannot be read ({why})"


def _parsed(table: Any) -> dict[str, dict[tuple[str, str], bool]]:
    if table.get("format") != _FORMAT or not isinstance(table.get("switches"), dict):
        raise InputError(f"holds no switches of format {_FORMAT}")
    found: dict[str, dict[tuple[str, str], bool]] = {}
    for robot, switches in table["switches"].items():
        for text, counts in switches.items():
            what, _, name = text.partition(" ")
            if what not in ("source", "zone") or not name or not isinstance(counts, bool):
                raise InputError(f"'{text}': wanted 'source NAME' or 'zone NAME', and true or false")
            found.setdefault(robot, {})[what, name] = counts
    return found


def save_overrides(path: Path, ordered: Ordered) -> str:
    """Puts the orders on the disk before it returns; what went wrong, or nothing."""
    named = {robot: {" ".join(key): counts for key, counts in own.items()} for robot, own in ordered.items()}
    switches = {robot: own for robot, own in named.items() if own}
    try:
        write_through(path, json.dumps({"format": _FORMAT, "switches": switches}))
    except OSError as error:
        return f"{path} cannot be written ({why_not_written(error)})"
    return ""


_WHAT = ("source", "zone")
_SETS = {"on": True, "off": False}
_Switched = Mapping[tuple[str, str], bool]
"""By ``source`` or ``zone`` and its name: whether it counts."""
_LONGEST_NAME = 60
"""Letters of who ordered."""
_MOST_SWITCHES = 64
"""Of one order."""


@final
class SensorOverrides:
    """Asked in every tick by perception, changed on any thread by ``answer``.

    An order holds until another one; a robot that was silent finds it in force. ``path`` is where orders are kept for
    the next process, without it they end with this one. What opens a zone is never kept: closed zones do not open, and
    ignored ones do not begin to be, by what someone ordered before a crash.
    """

    def __init__(self, settings: PerceptionSettings, path: Path | None = None) -> None:
        self._settings, self._path = settings, path
        self._lock = threading.Lock()
        retained, self.lost = ({}, "") if path is None else load_overrides(path)
        """Why kept orders cannot be read; empty: they can, or there are none."""
        self._ordered: dict[str, _Switched] = {
            robot: MappingProxyType(self._lasting(own)) for robot, own in retained.items()
        }
        """By robot; each replaced as a whole, so that a tick reads it without waiting."""
        self._who: dict[str, str] = {}
        """By robot: who ordered last."""
        self._met: dict[str, tuple[tuple[str, ...], int]] = {}
        """By robot: its sources, and its newest tick."""
        self._replayed: dict[str, ActiveZones] = {}

    def in_force(self, robot: str, sources: tuple[str, ...], tick: int) -> ActiveZones:
        """What counts for ``robot`` in this tick, whose state names ``sources``."""
        self._met[robot] = sources, tick
        if robot in self._replayed:
            return self._replayed[robot]
        reported = self._counts(robot)
        return ActiveZones(
            frozenset(name for name in sources if not reported["source", name]),
            tuple(zone for zone in self._settings.zones if reported.get(("zone", zone.name))),
            self._reported_of_orders(robot),
        )

    def replay(self, robot: str, off: Collection[str], zones: Collection[str], ordered: str) -> None:
        """From now on what a recording says: sources that are off, kind and name of the zones that count."""
        known = ActiveZones(frozenset(off), self._settings.zones)
        counting = (zone for zone, name in zip(known.zones, known.names, strict=True) if name in zones)
        self._replayed[robot] = ActiveZones(known.off, tuple(counting), ordered)

    def replays(self, robot: str) -> bool:
        """Whether a recording says what counts: then it is long ago, and no news."""
        return robot in self._replayed

    def _reported_of_orders(self, robot: str) -> str:
        """What was ordered for a robot, with who did; empty: nothing was."""
        reported = "; ".join(filter(None, (_listed(self._ordered.get(name, {})) for name in ("-", robot))))
        if not reported:
            return ""
        who = self._who.get(robot, "")
        return f"{reported}, {f'by {who}' if who else 'before perception was started'}"

    def forget(self, robot: str) -> None:
        """That it was met; what was ordered for it stays."""
        self._met.pop(robot, None)

    def _counts(self, robot: str) -> dict[tuple[str, str], bool]:
        """Of all that can be switched for a robot that was met: whether it counts."""
        own, (sources, _) = self._settings, self._met[robot]
        reported = {("source", name): name not in own.sources or own.sources[name].use for name in sources}
        reported |= {("zone", zone.name): zone.use for zone in own.zones if zone.counts_for(robot)}
        if not self._ordered.get("-", {}).get(EVERY_SOURCE, True):
            reported |= {("source", name): False for name in sources}
        ordered = self._ordered.get(robot, MappingProxyType({}))
        return {key: ordered.get(key, counts) for key, counts in reported.items()}

    @property
    def retained(self) -> dict[str, str]:
        """What was ordered, in words, by robot; ``-`` is each of them."""
        return {robot: _listed(own) for robot, own in self._ordered.items()}

    def answer(self, robot: str, request: Request) -> Answer:
        """``switch`` or ``status`` about one robot. Raises InputError for anything else, and what it does not have."""
        if request.do not in ("switch", "status"):
            raise InputError(f"'{request.do}': wanted switch or status")
        with self._lock:
            if robot not in self._met:
                raise InputError(
                    f"robot '{robot}' was not heard with sources of its own; {did_you_mean(robot, list(self._met))}"
                )
            before, tick = self._counts(robot), self._met[robot][1]
            if request.do == "status":
                return Answer(ok=True, sentence=f"robot '{robot}': {_listed(before)}{_blind(before)}")
            wanted = _wanted(request.switches, before)
            self._who[robot] = readable(request.who, _LONGEST_NAME) or "someone without a name"
            self._ordered[robot] = MappingProxyType({**self._ordered.get(robot, {}), **wanted})
            changes = ", ".join(
                f"{what} {name} {_word(counts)} (was {_word(before[what, name])})"
                for (what, name), counts in wanted.items()
            )
            return Answer(
                ok=True,
                sentence=f"robot '{robot}': {changes}, from its next tick after {tick} on, "
                f"{self._how_long(wanted)}{_blind({**before, **wanted})}",
            )

    def _how_long(self, wanted: _Switched) -> str:
        """Keeps what is kept; says until when what was ordered now holds."""
        if self._path is None:
            return "until another order or perception's end, since it keeps no file of orders"
        lasting = {robot: self._lasting(own) for robot, own in self._ordered.items()}
        problem = save_overrides(self._path, lasting)
        if problem:
            return f"until another order or perception's end: {problem}"
        opened = ", ".join(" ".join(key) for key in wanted if key not in self._lasting(wanted))
        return f"until another order{f', {opened} only until perception ends' if opened else ''}"

    def _lasting(self, ordered: _Switched) -> dict[tuple[str, str], bool]:
        """Without what opens a zone; of a zone that the file does not have no one knows what it does."""
        closed = {("zone", zone.name): zone.kind == "closed" for zone in self._settings.zones}
        return {key: counts for key, counts in ordered.items() if counts == closed.get(key, counts)}


def _wanted(switches: tuple[str, ...], known: Mapping[tuple[str, str], bool]) -> dict[tuple[str, str], bool]:
    """What an order asks for, all of it or nothing."""
    if not 1 <= len(switches) <= _MOST_SWITCHES:
        raise InputError(f"got {len(switches)} switches, wanted 1 to {_MOST_SWITCHES}, such as 'source laser=off'")
    wanted: dict[tuple[str, str], bool] = {}
    for text in switches:
        what, _, rest = text.partition(" ")
        name, _, word = rest.rpartition("=")
        if what not in _WHAT or not name or word not in _SETS:
            raise InputError(f"'{text}': wanted 'source NAME=on', 'zone NAME=off' or the like")
        names = [own for kind, own in known if kind == what]
        if name not in names:
            raise InputError(f"{what} '{name}': the robot has none of that name; {did_you_mean(name, names)}")
        if wanted.setdefault((what, name), _SETS[word]) != _SETS[word]:
            raise InputError(f"{what} '{name}': got on and off in one order, wanted one of them")
    return wanted


def _word(counts: bool) -> str:
    return "on" if counts else "off"


def _listed(reported: Mapping[tuple[str, str], bool]) -> str:
    return ", ".join(f"{what} {name} {_word(counts)}" for (what, name), counts in reported.items())


def _blind(reported: Mapping[tuple[str, str], bool]) -> str:
    sources = [counts for (what, _), counts in reported.items() if what == "source"]
    return "" if any(sources) else "; no source is left, so the filter brakes"
