"""Which lines of Zenoh's log are refusals of which kind, and how often it is told that some were passed over."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from safedpa_services.router import refusals as module
from safedpa_services.router.refusals import Refusals

LINE = "2026-11-21T20:33:49.171284Z {level} acc-0 ThreadId(05) {target}: {text}"


@pytest.mark.parametrize(
    ("target", "level", "text", "kinds"),
    [
        ("zenoh_link_tls::unicast", "DEBUG", "Accepted TLS connection on [::]:7447: 10.0.0.2:5. Common Name: policy.",
         ["bus.joined"]),
        ("zenoh_link_tls::unicast", "WARN", "no certificate", ["bus.handshake_refused"]),
        ("zenoh_transport::unicast::establishment::accept", "ERROR", "closed", ["bus.handshake_refused"]),
        ("zenoh_transport::unicast::establishment::accept", "DEBUG", "Decode error", ["bus.handshake_refused"]),
        ("zenoh_transport::unicast::establishment::accept", "DEBUG", "hello", []),
        ("zenoh_transport::unicast::establishment::open", "WARN", "closed", ["bus.zenoh"]),
        ("zenoh::net::runtime", "WARN", "closed", ["bus.zenoh"]),
        ("zenoh::net::runtime", "DEBUG", "closed", []),
    ],
)  # fmt: skip
def test_a_handshake_that_failed_is_a_refusal_and_what_else_goes_wrong_is_told(
    target: str, level: str, text: str, kinds: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[str] = []
    monkeypatch.setattr(module, "log_event", lambda kind, *_, **__: told.append(kind))
    refusals = Refusals()
    refusals.hear(LINE.format(level=level, target=target, text=text))
    assert told == kinds
    assert refusals.total == (1 if kinds == ["bus.handshake_refused"] else 0)


@pytest.mark.parametrize(
    ("allowed", "act", "kind"),
    [
        (True, "Put", "bus.too_large"),
        (False, "Put", "bus.denied"),
        (True, "Delete", "bus.denied"),
        (False, "Query", "bus.denied"),
    ],
)
def test_only_a_message_that_was_allowed_and_goes_no_further_was_too_large(
    allowed: bool, act: str, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[tuple[str, str]] = []
    monkeypatch.setattr(module, "log_event", lambda kind, _, robot, **__: told.append((kind, robot)))
    refusals = Refusals()
    access = "zenoh::net::routing::interceptor::access_control"
    text = f"ab is {'' if allowed else 'un'}authorized to {act} (ingress) on safedpa/f/r1/action"
    refusals.hear(LINE.format(level="TRACE", target=access, text=text))
    refusals.hear(LINE.format(level="TRACE", target="zenoh::net::routing::interceptor", text="Msg intercepted!"))
    assert told == [(kind, "r1")]
    assert refusals.counts == {kind: 1}


class SeenEnoughError(Exception):
    """Ends what goes on for ever."""


@pytest.mark.parametrize(
    ("passed_over", "told"),
    [
        ([0] * 200, []),
        ([*[0] * 9, *[5] * 191], [50]),  # once, and a second after it began to look at the earliest
        ([*[0] * 99, *[5] * 101], [100]),
        (list(range(1, 201)), [50, 100, 150, 200]),
    ],
    ids=["nothing", "once", "later", "always"],
)
def test_that_lines_were_passed_over_is_told_once_a_second_at_most_and_only_where_more_were(
    passed_over: list[int], told: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Looked at every 0.02 s; lines are heard in order."""
    looks, events, lines = [0], list[int](), list[str]()

    class Pause:
        def wait(self, seconds: float) -> None:
            assert seconds == 0.02
            if looks[0] == len(passed_over):
                raise SeenEnoughError

    class File:
        @property
        def passed_over(self) -> int:
            return passed_over[looks[0] - 1]

        def lines(self) -> list[str]:
            looks[0] += 1
            return [f"line {looks[0]}"]

    file: Any = File()
    monkeypatch.setattr(module, "threading", SimpleNamespace(get_native_id=lambda: 0, Event=Pause))
    monkeypatch.setattr(module.os, "sched_setscheduler", lambda *_: None)
    monkeypatch.setattr(module.os, "setpriority", lambda *_: None)
    monkeypatch.setattr(module, "log_event", lambda *_, **__: events.append(looks[0]))
    with pytest.raises(SeenEnoughError):
        module._read(file, lines.append)
    assert events == told
    assert lines == [f"line {number}" for number in range(1, 201)]
