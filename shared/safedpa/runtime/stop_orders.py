"""Stop orders, stored on disk so that they remain in force when the filter restarts.

There are orders for one robot and orders for the whole fleet, including robots that join later. A robot may drive if
neither is in force. If the file cannot be read, the whole fleet is stopped: a lost order would release a robot that a
person has stopped.
"""

from __future__ import annotations

import contextlib
import json
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType

from safedpa.bus import Answer, Request
from safedpa.disk import write_through
from safedpa.errors import InputError
from safedpa.limits import parse_json, text_of_file

EVERYBODY = "-"
"""Placeholder for the robot in an order for the whole fleet."""
IMPLAUSIBLE = "because its state is implausible: "
"""Part of the reason of an order that the filter gave itself."""
_FORMAT = 1


class StopOrders:
    """The stop orders in force. The filter reads them every tick; ``answer`` changes them on any thread.

    ``path`` is the file of the orders. Without it they are lost when this process ends, and the answers say so.
    """

    def __init__(self, path: Path | None = None) -> None:
        self._path = path
        self._lock = threading.Lock()
        self._active: Mapping[str, str] = MappingProxyType({} if path is None else _read(path))
        """Reason of the order by robot. Replaced as a whole, so that a tick can read it without the lock."""
        self._ending = ""
        self.on_change: Callable[[], None] = lambda: None
        """Called on any thread after orders have changed."""

    def reason(self, robot: str) -> str:
        """Returns why the robot has to stop; empty if it may drive."""
        return self._ending or self._active.get(EVERYBODY, "") or self._active.get(robot, "")

    def end(self, reason: str) -> None:
        """Stops all robots until this process ends; not stored, so they may drive under the next filter."""
        self._ending = reason

    def latch(self, robot: str, reason: str) -> None:
        """Stops a robot whose state is implausible for this reason, until ``go``, or ``confirm`` if that is all."""
        with self._lock:
            before = self._active.get(robot, "")
            ordered = f"{before}; and " if before and not before.startswith(IMPLAUSIBLE) else ""
            self._change({**self._active, robot: f"{ordered}{IMPLAUSIBLE}{reason}"})

    def replay(self, robot: str, reason: str) -> None:
        """Has this recorded reason alone in force, from any sender and for any robot; empty: the robot may drive."""
        with self._lock:
            self._active = MappingProxyType({robot: reason} if reason else {})

    @property
    def active(self) -> dict[str, str]:
        """The orders in force by robot; ``-`` is the whole fleet."""
        return dict(self._active)

    def text(self) -> str:
        """Returns the orders in force, for another filter that takes over."""
        return _text(self._active)

    def inherit(self, text: str) -> None:
        """Adds the orders of the filter before this one; if they cannot be read, the whole fleet is stopped."""
        if not text:
            return
        with self._lock:
            self._change({**_parsed(text, "what the filter before carried on"), **self._active})

    def answer(self, robot: str, request: Request) -> Answer:
        """Handles ``stop``, ``go``, ``confirm`` or ``status`` for a robot, or for the fleet (``-``).

        ``confirm`` lets a robot drive again that is stopped for an implausible state alone: a localisation vouches for
        the next state. It ends no order of a person. Raises InputError for any other request.
        """
        if request.do == "status":
            reason = self.reason(robot)
            how = f"is stopped, {reason}" if reason else f"may drive{self._others()}"
            return Answer(ok=True, sentence=f"{_named(robot)} {how}")
        if request.do not in ("stop", "go", "confirm"):
            raise InputError(f"order '{request.do}': wanted stop, go, confirm or status")
        with self._lock:
            if request.do == "confirm" and not self._active.get(robot, "").startswith(IMPLAUSIBLE):
                return Answer(ok=False, sentence=f"refused: no implausible state alone stops {_named(robot)}")
            return self._stop(robot, request.who) if request.do == "stop" else self._go(robot)

    def _stop(self, robot: str, who: str) -> Answer:
        reason = f"ordered by {who or 'an unnamed user'}"
        problem = self._change({**self._active, robot: reason})
        return Answer(ok=True, sentence=f"{_named(robot)} stops, {reason}{self._how_long(problem)}")

    def _go(self, robot: str) -> Answer:
        if robot != EVERYBODY and EVERYBODY in self._active:
            return Answer(ok=False, sentence=f"refused: the whole fleet is stopped, {self._active[EVERYBODY]}")
        if robot not in self._active:
            return Answer(ok=False, sentence=f"refused: {_named(robot)} is not stopped by an order{self._others()}")
        problem = self._change({name: why for name, why in self._active.items() if name != robot})
        again = f"; but a restarted filter will stop it again: {problem}" if problem else ""
        return Answer(ok=True, sentence=f"{_named(robot)} may drive{self._others()}{again}")

    def _others(self) -> str:
        single = sorted(name for name in self._active if name != EVERYBODY)
        return f"; still stopped: {', '.join(single)}" if single else ""

    def _how_long(self, problem: str) -> str:
        if self._path is None:
            return "; valid until 'go' or the end of the filter, which has no file of orders"
        return f"; valid until 'go' or the end of the filter: {problem}" if problem else "; valid until 'go'"

    def _change(self, active: dict[str, str]) -> str:
        """Applies the orders, then writes them to disk; returns a problem with the disk, or an empty text."""
        # Applied first: a slow or full disk must not delay a stop.
        self._active = MappingProxyType(active)
        self.on_change()
        if self._path is None:
            return ""
        try:
            write_through(self._path, _text(active))
        except OSError as error:
            return f"{self._path} cannot be written ({error.strerror})"
        return ""


def _named(robot: str) -> str:
    return "the whole fleet" if robot == EVERYBODY else f"robot '{robot}'"


def _read(path: Path) -> dict[str, str]:
    """Reads the stored orders; returns an order for the whole fleet if the file exists but cannot be read."""
    try:
        text = text_of_file(path, "json_bytes")
    except FileNotFoundError:
        return {}
    except (OSError, UnicodeDecodeError, InputError) as error:
        return {EVERYBODY: f"because the orders in {path} cannot be read ({type(error).__name__})"}
    return _parsed(text, str(path))


def _text(active: Mapping[str, str]) -> str:
    return json.dumps({"format": _FORMAT, "orders": dict(active)})


def _parsed(text: str, source: str) -> dict[str, str]:
    with contextlib.suppress(InputError, AttributeError):
        table = parse_json(text)
        orders = table.get("orders")
        if table.get("format") == _FORMAT and isinstance(orders, dict):
            return {str(robot): str(why) for robot, why in orders.items()}
    return {EVERYBODY: f"because {source} has no orders of format {_FORMAT}"}
