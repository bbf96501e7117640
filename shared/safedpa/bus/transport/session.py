"""Zenoh sessions, opened and closed so that one that stands still takes no other with it."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from safedpa.bus.log import log_event

if TYPE_CHECKING:
    import zenoh

__all__ = ["close_in_peace", "configuration_of", "first_clause", "open_session"]

_NET_THREADS = 4
"""Threads with which Zenoh opens and closes links, for all sessions of a process. By default it is one; where peers
come and go it waited for a lock whose holder waited for it, and every session of the process stood still for good.
https://github.com/eclipse-zenoh/zenoh/issues/2581; ``deploy/zenoh_churn.py`` brings it about."""
_UNCLOSED: list[Any] = []
"""Sessions that did not close: letting go of one would close it again, for as long, and abort the thread."""


def configuration_of(settings: Mapping[str, Any]) -> zenoh.Config:
    """Zenoh's configuration of paths and values. Raises zenoh.ZError for a value that cannot be."""
    import zenoh

    configuration = zenoh.Config()
    for path, value in settings.items():
        configuration.insert_json5(path, json.dumps(value))
    return configuration


def open_session(configuration: zenoh.Config) -> zenoh.Session:
    """A session. Raises zenoh.ZError where it cannot be opened."""
    import zenoh

    os.environ.setdefault("ZENOH_RUNTIME", f"(net: (worker_threads: {_NET_THREADS}))")  # read with the first session
    return zenoh.open(configuration)


def close_in_peace(session: zenoh.Session) -> None:
    """Closes a session; one that does not close in Zenoh's 10 s is told, and kept: it ends with the process."""
    import zenoh

    if session.is_closed():
        return
    try:
        session.close()  # type: ignore[no-untyped-call]
    except zenoh.ZError as error:  # https://github.com/eclipse-zenoh/zenoh/issues/2675, on a busy machine
        _UNCLOSED.append(session)
        log_event("bus.unclosed", f"the bus could not be closed in peace ({first_clause(error)})", level="warning")


def first_clause(error: Exception) -> str:
    """What Zenoh says, on one line, without the places in its own sources."""
    return " ".join(str(error).split(" at /")[0].split())
