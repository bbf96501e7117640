"""``python -m safedpa_lab.benchmarks.hostile.offering``: who has a diagnosis' key, and offers what takes long.

For some seconds it only listens, for as many it offers, in turn, until it is ended; then it writes what it saw: how
long each refusal took after the state of its tick.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import cycle
from pathlib import Path
from typing import Any

from safedpa.bus import (
    ACTION,
    LATENT,
    MODEL,
    NOMINAL,
    STATE,
    TAKEOVER,
    Bus,
    ModelMessage,
    ReceivedMessage,
    TakeoverMessage,
)
from safedpa.bus.service.process import StopSignal, add_bus_options, bus_from_options, run_process
from safedpa.dynamics import fingerprint, load_model, parse_model, write_model
from safedpa.effects.library import effects_of
from safedpa.errors import InputError

FREEZES = "a key of 50,000 parts"
"""It once froze a machine for 22 s."""
BOMBS = {
    FREEZES: "a" + ".a" * 50_000 + " = 1\n",
    "a key of 30,000 parts": "a" + ".a" * 30_000 + " = 1\n",
    "arrays in arrays": "x = " + "[" * 60_000,
    "a number of 60,000 digits": "period = " + "1" * 60_000,
    "a string without an end": '"""\\' * 10_000,
    "60,000 empty lines": "\n" * 60_000,
    "a megabyte": "#" * 1_000_000,
}
"""Documents that take long to read, or much to hold."""
_PAUSE_SECONDS = 0.1
"""From one offer to the next."""
_CACHED = 20_000
_CHAIN = (STATE, LATENT, NOMINAL, ACTION)
_LARGEST = 10_000


def costly_model() -> str:
    """One that can be read and used, with every effect that the car takes, free as far as the limits let it be."""
    text = write_model(load_model("car"))
    for item in effects_of("car").values():
        lines = "".join(f"{p.name} = {{ value = {p.start!r}, free = true }}\n" for p in item.parameters)
        longer = f'{text}\n[[effects]]\nname = "{item.name}"\n{lines}'
        with contextlib.suppress(InputError):
            parse_model(longer)
            text = longer
    return text


@dataclass
class _Seen:
    """What passed by, by robot and tick."""

    offers: dict[tuple[str, int], tuple[str, float]] = field(default_factory=dict)
    states: dict[tuple[str, int], float] = field(default_factory=dict)
    refusals: list[dict[str, Any]] = field(default_factory=list)
    chains: dict[str, dict[str, float]] = field(default_factory=dict)
    """By robot and tick: when each message of it came first."""

    def hear(self, item: ReceivedMessage) -> None:
        """One message of anybody's."""
        message = item.message
        key = (item.robot, message.tick)
        if item.topic in _CHAIN:
            self.chains.setdefault(f"{item.robot} {message.tick}", {}).setdefault(item.topic.name, item.at)
            if len(self.chains) > _CACHED:
                del self.chains[next(iter(self.chains))]
        if item.topic is STATE:
            self.states[key] = item.at
            if len(self.states) > _CACHED:
                del self.states[next(iter(self.states))]
        elif isinstance(message, TakeoverMessage):
            name, sent = self.offers.get((item.robot, message.change), ("", 0.0))
            if name and len(self.refusals) < _LARGEST:
                self.refusals.append({
                    "offer": name,
                    "service": message.service,
                    "state": message.state,
                    "reason": message.reason[:200],
                    "seconds": item.at - sent,
                    "after_state_seconds": item.at - self.states[key] if key in self.states else None,
                })  # fmt: skip


def _offer(change: int, document: str, fingerprint: str) -> ModelMessage:
    return ModelMessage(
        epoch=1, tick=0, robot_time=0.0, publish_time=time.time(), step="offer", change=change,
        fingerprint=fingerprint, replaces="", document=document, who="someone with a stolen key",
    )  # fmt: skip


def _attack(
    bus: Bus, seen: _Seen, robots: list[str], stretch: float, stop: StopSignal
) -> Iterator[tuple[float, float]]:
    """The stretches of time in which it was attacked, as each of them ends; in between there is peace."""
    costly = costly_model()
    documents = {name: (text, "0123456789ab") for name, text in BOMBS.items()}
    documents["a model that takes long to try"] = costly, fingerprint(parse_model(costly))
    inbox = bus.inbox((*_CHAIN, TAKEOVER))
    turn = cycle([(robot, name) for name in documents for robot in robots])
    change, attacking, since = 0, False, time.monotonic()
    due = since
    while True:
        for item in inbox.take(0.01):
            if isinstance(item, ReceivedMessage):
                seen.hear(item)
        now = time.monotonic()
        if stop() or now - since >= stretch:
            if attacking:
                yield since, now
            if stop():
                return
            attacking, since, due = not attacking, now, now
        if attacking and now >= due:
            robot, name = next(turn)
            change, due = change + 1, due + _PAUSE_SECONDS
            seen.offers[robot, change] = name, time.monotonic()
            bus.publish(MODEL, robot, _offer(change, *documents[name]))


def work(options: argparse.Namespace, stop: StopSignal) -> int:
    """Attacks every other stretch of time until ``stop``, and writes the account."""
    robots = [f"car{index:04d}" for index in range(options.robots)]
    seen, windows = _Seen(), []
    with bus_from_options(options) as bus:
        for window in _attack(bus, seen, robots, options.stretch, stop):
            windows.append(window)
    account = {"windows": windows, "offers": len(seen.offers), "refusals": seen.refusals, "chains": seen.chains}
    options.account.write_text(json.dumps(account), encoding="utf-8")
    return 0


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="safedpa-offering")
    add_bus_options(parser)
    parser.add_argument("--robots", type=int, default=8)
    parser.add_argument("--stretch", type=float, default=5.0, help="seconds of peace, then of attack, and so on")
    parser.add_argument("--account", type=Path, required=True)
    run_process(work, parser)  # with --realtime behind the loop and before the rest, to tell the time well
