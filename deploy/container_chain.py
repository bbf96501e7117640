"""A bare chain of containers: hands bytes on from one to the next and nothing else, for ``container_latency.py``.

    python container_chain.py relay SOURCE TARGET       on a bus, until it is ended
    python container_chain.py send SOURCE TARGET SECONDS RATE    prints p50, p99, p999 [us] and the share that was late

The sender waits until its bytes come back once, then sends ``RATE`` times a second.
"""

from __future__ import annotations

import json
import sys
import threading
import time

from safedpa.bus import ZenohSettings, ZenohTransport

ROUTER = "tcp/router:7447"
PAYLOAD = bytes(600)
"""As large as a state message with six obstacles."""
_START_SECONDS = 30.0


def relay(transport: ZenohTransport, source: str, target: str) -> None:
    """Never ends."""
    transport.subscribe(source, lambda _, payload: transport.put(target, payload, never_drop=False))
    threading.Event().wait()


def send(transport: ZenohTransport, source: str, target: str, seconds: float, rate: float) -> dict[str, float]:
    """Percentiles of the microseconds from sending to arrival. Raises TimeoutError where nothing ever comes back."""
    arrived = threading.Event()
    transport.subscribe(target, lambda _key, _payload: arrived.set())
    deadline = time.monotonic() + _START_SECONDS
    while not arrived.is_set():
        if time.monotonic() > deadline:
            raise TimeoutError(f"nothing came back from {source} to {target} within {_START_SECONDS:.0f} s")
        transport.put(source, PAYLOAD, never_drop=False)
        arrived.wait(0.2)
    time.sleep(1.0)  # what was sent more than once is gone then
    count, microseconds = round(seconds * rate), list[float]()
    for _ in range(count):
        began = time.perf_counter()
        arrived.clear()
        transport.put(source, PAYLOAD, never_drop=False)
        if arrived.wait(1.0):
            microseconds.append(1e6 * (time.perf_counter() - began))
        time.sleep(max(0.0, 1.0 / rate - (time.perf_counter() - began)))
    return account(microseconds, count, rate)


def account(microseconds: list[float], sent: int, rate: float) -> dict[str, float]:
    """Percentiles, and the share that took longer than a period or never came. Raises TimeoutError if none came."""
    if not microseconds:
        raise TimeoutError(f"none of {sent} messages came back")
    ordered = sorted(microseconds)
    shares = {"p50": 0.5, "p99": 0.99, "p999": 0.999}
    most = len(ordered) - 1
    found = {name: round(ordered[min(most, int(share * len(ordered)))], 1) for name, share in shares.items()}
    return {**found, "late_share": 1.0 - sum(value <= 1e6 / rate for value in ordered) / sent}


def main() -> None:
    """One end, or one link."""
    what, source, target, *numbers = sys.argv[1:]
    transport = ZenohTransport(ZenohSettings(mode="client", connect=(ROUTER,)))
    if what == "relay":
        relay(transport, source, target)
    sys.stdout.write(json.dumps(send(transport, source, target, *map(float, numbers))) + "\n")
    transport.close()


if __name__ == "__main__":
    main()
