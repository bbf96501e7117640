"""Orders to stop that are in force: kept on disk, so that a filter that is started again still knows them.

Two kinds stand side by side: an order about one robot, and one about the whole fleet, robots that come later among
them. A robot drives when neither is in force. What cannot be read counts as an order to stop everybody: an order that
was lost would let robots drive that someone stopped.
"""

from __future__ import annotations

import contextlib
import json
import threading
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

from safedpa.bus import Answer, Request
from safedpa.disk import write_through
from safedpa.errors import InputError
from safedpa.limits import parse_json, text_of_file

__all__ = ["EVERYBODY", "StopOrders"]

EVERYBODY = "-"
"""Stands for the robot in an order about the whole fleet."""
_FORMAT = 1


class StopOrders:
    """Who is to stand, and why. Asked in every tick by the filter, changed on any thread by ``answer``.

    ``path`` is where the orders are kept; without it they are forgotten when this process ends, and the answers say so.
    """

    def __init__(self, path: Path | None = None) -> None:
        self._path = path
        self._lock = threading.Lock()
        self._active: Mapping[str, str] = MappingProxyType({} if path is None else _read(path))
        """By robot: why it is to stand. Replaced as a whole, so that a tick reads it without waiting."""
        self._ending = ""

    def reason(self, robot: str) -> str:
        """Why the robot is to stand; empty: it may drive."""
        return self._ending or self._active.get(EVERYBODY, "") or self._active.get(robot, "")

    def end(self, reason: str) -> None:
        """Stops everybody until this process ends; never kept, so the next one lets them drive."""
        self._ending = reason

    @property
    def active(self) -> dict[str, str]:
        """The orders in force, by robot; ``-`` is the whole fleet."""
        return dict(self._active)

    def answer(self, robot: str, request: Request) -> Answer:
        """``stop``, ``go`` or ``status`` about a robot, or about the fleet where the robot is ``-``.

        Raises InputError for anything else.
        """
        if request.do == "status":
            return Answer(ok=True, sentence=self._reported(robot))
        if request.do not in ("stop", "go"):
            raise InputError(f"order '{request.do}': wanted stop, go or status")
        with self._lock:
            return self._stop(robot, request.who) if request.do == "stop" else self._go(robot)

    def _stop(self, robot: str, who: str) -> Answer:
        reason = f"ordered by {who or 'someone who gave no name'}"
        problem = self._change({**self._active, robot: reason})
        return Answer(ok=True, sentence=f"{_named(robot)} stops, {reason}{self._how_long(problem)}")

    def _go(self, robot: str) -> Answer:
        if robot != EVERYBODY and EVERYBODY in self._active:
            return Answer(ok=False, sentence=f"refused: the whole fleet is stopped, {self._active[EVERYBODY]}")
        if robot not in self._active:
            return Answer(ok=False, sentence=f"refused: {_named(robot)} is not stopped by an order{self._others()}")
        problem = self._change({name: why for name, why in self._active.items() if name != robot})
        again = f"; but a filter that is started again will stop it again: {problem}" if problem else ""
        return Answer(ok=True, sentence=f"{_named(robot)} may drive{self._others()}{again}")

    def _others(self) -> str:
        single = sorted(name for name in self._active if name != EVERYBODY)
        return f"; still stopped: {', '.join(single)}" if single else ""

    def _reported(self, robot: str) -> str:
        reason = self.reason(robot)
        return f"{_named(robot)} stands, {reason}" if reason else f"{_named(robot)} may drive{self._others()}"

    def _how_long(self, problem: str) -> str:
        if self._path is None:
            return "; held until 'go' or the filter's end, since it keeps no file of orders"
        return f"; held until 'go' or the filter's end: {problem}" if problem else "; held until 'go'"

    def _change(self, active: dict[str, str]) -> str:
        """Puts the orders in force, then on disk; what went wrong with the disk, or nothing."""
        self._active = MappingProxyType(active)
        if self._path is None:
            return ""
        try:
            write_through(self._path, json.dumps({"format": _FORMAT, "orders": active}))
        except OSError as error:
            return f"{self._path} cannot be written ({error.strerror})"
        return ""


def _named(robot: str) -> str:
    return "the whole fleet" if robot == EVERYBODY else f"robot '{robot}'"


def _read(path: Path) -> dict[str, str]:
    """The orders kept; one to stop everybody where the file is there but cannot be read."""
    try:
        text = text_of_file(path, "json_bytes")
    except FileNotFoundError:
        return {}
    except (OSError, UnicodeDecodeError, InputError) as error:
        return {EVERYBODY: f"since the orders in {path} cannot be read ({type(error).__name__})"}
    with contextlib.suppress(InputError, AttributeError):
        table = parse_json(text)
        orders = table.get("orders")
        if table.get("format") == _FORMAT and isinstance(orders, dict):
            return {str(robot): str(why) for robot, why in orders.items()}
    return {EVERYBODY: f"since {path} holds no orders of format {_FORMAT}"}
