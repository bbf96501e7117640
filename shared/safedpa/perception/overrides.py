"""Overrides of sources and zones: which of them are active, by the settings file and the orders of users.

Orders are stored on disk, so that they survive a restart of perception.
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
"""Whether a ("source" or "zone", name) is active, by robot (``-`` for all)."""
EVERY_SOURCE: Final = ("source", "*")
_FORMAT = 1


def load_overrides(path: Path) -> tuple[dict[str, dict[tuple[str, str], bool]], str]:
    """Loads the orders in a file, empty if there is none; also returns why they cannot be read, else "".

    Lost orders may have closed a zone or disabled a faulty source. If the file is unreadable, all sources of all robots
    are therefore off until a user switches them on, and the filter brakes.
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
    """Saves the orders durably; returns the problem, or an empty text."""
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
"""Whether a ("source" or "zone", name) is active."""
_MAX_NAME_LENGTH = 60
"""Characters of the name of a user."""
_MAX_SWITCHES = 64
"""Largest number of switches in one order."""


@final
class SensorOverrides:
    """Active sources and zones: read by perception in every tick, changed by ``answer`` on any thread.

    An order is valid until the next one, also for a robot that was silent. Orders are saved to ``path``; without it
    they end with this process. Orders that open a closed zone or ignore a zone are never saved: a restart must not make
    perception less cautious.
    """

    def __init__(self, settings: PerceptionSettings, path: Path | None = None) -> None:
        self._settings, self._path = settings, path
        self._lock = threading.Lock()
        retained, self.lost = ({}, "") if path is None else load_overrides(path)
        """Why the saved orders cannot be read; empty if they can or if there are none."""
        self._ordered: dict[str, _Switched] = {
            robot: MappingProxyType(self._saved_part(own)) for robot, own in retained.items()
        }
        """Orders by robot; each mapping is replaced as a whole, so that a tick reads it without a lock."""
        self._who: dict[str, str] = {}
        """Last user who gave an order, by robot."""
        self._robots: dict[str, tuple[tuple[str, ...], int]] = {}
        """Sources and newest tick, by robot."""
        self._replayed: dict[str, ActiveZones] = {}

    def in_force(self, robot: str, sources: tuple[str, ...], tick: int) -> ActiveZones:
        """Active sources and zones of ``robot`` in this tick, whose state lists ``sources``."""
        self._robots[robot] = sources, tick
        if robot in self._replayed:
            return self._replayed[robot]
        counts = self._counts(robot)
        return ActiveZones(
            frozenset(name for name in sources if not counts["source", name]),
            tuple(zone for zone in self._settings.zones if counts.get(("zone", zone.name))),
            self._orders_text(robot),
        )

    def replay(self, robot: str, off: Collection[str], zones: Collection[str], ordered: str) -> None:
        """Uses the values of a recording from now on: disabled sources, and kind and name of the active zones."""
        known = ActiveZones(frozenset(off), self._settings.zones)
        counting = (zone for zone, name in zip(known.zones, known.names, strict=True) if name in zones)
        self._replayed[robot] = ActiveZones(known.off, tuple(counting), ordered)

    def replays(self, robot: str) -> bool:
        """Whether the values come from a recording, so that changes need not be logged."""
        return robot in self._replayed

    def _orders_text(self, robot: str) -> str:
        """Text of the orders for a robot and of the user who gave them; empty if there are none."""
        orders = "; ".join(filter(None, (_listed(self._ordered.get(name, {})) for name in ("-", robot))))
        if not orders:
            return ""
        who = self._who.get(robot, "")
        return f"{orders}, {f'by {who}' if who else 'before perception was started'}"

    def forget(self, robot: str) -> None:
        """Forgets the robot; its orders stay."""
        self._robots.pop(robot, None)

    def _counts(self, robot: str) -> dict[tuple[str, str], bool]:
        """Whether each source and zone of a known robot is active."""
        own, (sources, _) = self._settings, self._robots[robot]
        counts = {("source", name): name not in own.sources or own.sources[name].use for name in sources}
        counts |= {("zone", zone.name): zone.use for zone in own.zones if zone.counts_for(robot)}
        if not self._ordered.get("-", {}).get(EVERY_SOURCE, True):
            counts |= {("source", name): False for name in sources}
        ordered = self._ordered.get(robot, MappingProxyType({}))
        return {key: ordered.get(key, value) for key, value in counts.items()}

    @property
    def retained(self) -> dict[str, str]:
        """Text of the orders by robot (``-`` for all)."""
        return {robot: _listed(own) for robot, own in self._ordered.items()}

    def answer(self, robot: str, request: Request) -> Answer:
        """Answers ``switch`` or ``status``; raises InputError for anything else or an unknown name."""
        if request.do not in ("switch", "status"):
            raise InputError(f"'{request.do}': wanted switch or status")
        with self._lock:
            if robot not in self._robots:
                raise InputError(
                    f"robot '{robot}' is not known with sources of its own; {did_you_mean(robot, list(self._robots))}"
                )
            before, tick = self._counts(robot), self._robots[robot][1]
            if request.do == "status":
                return Answer(ok=True, sentence=f"robot '{robot}': {_listed(before)}{_no_source_warning(before)}")
            wanted = _wanted(request.switches, before)
            self._who[robot] = readable(request.who, _MAX_NAME_LENGTH) or "an unnamed user"
            self._ordered[robot] = MappingProxyType({**self._ordered.get(robot, {}), **wanted})
            changes = ", ".join(
                f"{what} {name} {_on_off(counts)} (was {_on_off(before[what, name])})"
                for (what, name), counts in wanted.items()
            )
            return Answer(
                ok=True,
                sentence=f"robot '{robot}': {changes}, from its next tick after {tick} on, "
                f"{self._save_and_describe(wanted)}{_no_source_warning({**before, **wanted})}",
            )

    def _save_and_describe(self, wanted: _Switched) -> str:
        """Saves the orders; returns a text about how long the new ones are valid."""
        if self._path is None:
            return "until another order or the end of perception, which has no file for orders"
        saved_part = {robot: self._saved_part(own) for robot, own in self._ordered.items()}
        problem = save_overrides(self._path, saved_part)
        if problem:
            return f"until another order or the end of perception: {problem}"
        opened = ", ".join(" ".join(key) for key in wanted if key not in self._saved_part(wanted))
        return f"until another order{f', {opened} only until perception ends' if opened else ''}"

    def _saved_part(self, ordered: _Switched) -> dict[tuple[str, str], bool]:
        """The orders without those that open a zone; orders about a zone that is not in the file are kept."""
        closed = {("zone", zone.name): zone.kind == "closed" for zone in self._settings.zones}
        return {key: counts for key, counts in ordered.items() if counts == closed.get(key, counts)}


def _wanted(switches: tuple[str, ...], known: Mapping[tuple[str, str], bool]) -> dict[tuple[str, str], bool]:
    """Parses the switches of an order; raises InputError if any of them is invalid."""
    if not 1 <= len(switches) <= _MAX_SWITCHES:
        raise InputError(f"got {len(switches)} switches, wanted 1 to {_MAX_SWITCHES}, such as 'source laser=off'")
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


def _on_off(counts: bool) -> str:
    return "on" if counts else "off"


def _listed(counts: Mapping[tuple[str, str], bool]) -> str:
    return ", ".join(f"{what} {name} {_on_off(counts)}" for (what, name), counts in counts.items())


def _no_source_warning(counts: Mapping[tuple[str, str], bool]) -> str:
    sources = [counts for (what, _), counts in counts.items() if what == "source"]
    return "" if any(sources) else "; no source is left, so the filter brakes"
