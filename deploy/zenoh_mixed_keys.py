"""Under which keys messages come where links are lost and made again while many wait to be taken.

    python deploy/zenoh_mixed_keys.py --seconds 12 --sessions 16 --busy 3

One router says each of some keys again and again, with the key as the payload; sessions that cannot keep up lose their
links (a lease of half a second) and connect again. Prints for each session how many messages came, how many of them
under another key than they were sent under, and how many of those the bus reported those who listen to it (the key goes
next to each message as a stamp: none); then the same once all is quiet. Zenoh names keys by numbers
that each link agrees on again: what came over the old link seems to be read by the numbers of the new one.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from safedpa.bus import ZenohSettings, ZenohTransport
from safedpa.bus.security.certificate_authority import HOSTS, Authority
from safedpa.bus.security.certificates import Certificates
from safedpa.bus.transport import ports

KEYS = tuple(f"safedpa/f/r{robot}/{topic}" for robot in (1, 2) for topic in "abcdefghijklm")
PATTERNS = (*(f"{key}/*" for key in KEYS), *(f"safedpa/f/*/{key[-1]}/*" for key in KEYS), *KEYS, "safedpa/f/**", "**")


class Heard:
    """Of one session."""

    def __init__(self, transport: ZenohTransport) -> None:
        import zenoh

        self.count = self.wrong = self.reported = self.reported_wrong = 0
        handler: Any = zenoh.handlers.Callback(self._take, indirect=False)
        self._retained = [transport._session.declare_subscriber(pattern, handler) for pattern in PATTERNS]
        transport.subscribe("safedpa/f/**", self._report)

    def _take(self, sample: Any) -> None:
        self.count += 1
        self.wrong += str(sample.key_expr) != sample.payload.to_string()

    def _report(self, key: str, payload: bytes) -> None:
        self.reported += 1
        self.reported_wrong += key.encode() != payload

    def numbers(self) -> str:
        """They begin again."""
        notice = f"{self.wrong} of {self.count}, of the bus {self.reported_wrong} of {self.reported}"
        self.count = self.wrong = self.reported = self.reported_wrong = 0
        return notice


def measure(seconds: float, sessions: int) -> list[str]:
    """The lines that are printed."""
    endpoint = f"tls/127.0.0.1:{ports.free_port()}"
    with tempfile.TemporaryDirectory() as folder:
        authority = Authority(Path(folder), "f")
        for role in ("router", "recorder"):
            authority.issue(role, 1.0, HOSTS if role == "router" else ())
        router = ZenohTransport(ZenohSettings("router", (endpoint,), (), Certificates(Path(folder), "router")))
        card = Certificates(Path(folder), "recorder")
        settings = ZenohSettings("client", (), (endpoint,), card, connect_timeout=30.0)
        return notice(router, [ZenohTransport(settings) for _ in range(sessions)], seconds)


def notice(router: ZenohTransport, members: list[ZenohTransport], seconds: float) -> list[str]:
    """The lines, of sessions that are open, and then closed."""
    heard = [Heard(member) for member in members]
    fewest, end = len(members), time.monotonic() + seconds
    while time.monotonic() < end:
        for key in KEYS:
            router.put(key, key.encode(), never_drop=False)
        fewest = min(fewest, len(list(router._session.info.links())))
        time.sleep(0.005)
    time.sleep(5.0)
    lines = [f"links of {len(members)} sessions: {fewest} at the fewest"]
    lines += [f"session {number}: under another key {one.numbers()}" for number, one in enumerate(heard)]
    for _ in range(5):
        for key in KEYS:
            router.put(key, key.encode(), never_drop=False)
        time.sleep(0.3)
    time.sleep(1.0)
    lines.append("afterwards: " + "; ".join(one.numbers() for one in heard))
    for transport in (*members, router):
        transport.close()
    return lines


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=12.0)
    parser.add_argument("--sessions", type=int, default=16)
    parser.add_argument("--busy", type=int, default=3, help="processes that compute meanwhile")
    options = parser.parse_args()
    others = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(options.busy)]
    sys.stdout.write("\n".join(measure(options.seconds, options.sessions)) + "\n")
    for other in others:
        other.kill()


if __name__ == "__main__":
    main()
