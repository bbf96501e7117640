"""Runs in a container on the fleet's bus and tries attacks; prints what it did as one line of JSON.

``enter``: opens a session as HOW says. ``capture``: records actions sent to robots. ``act``: commands a robot to drive
at full speed, or HOW. ``replay``: sends what was captured, again. ``large``, ``malformed``: sends bytes
that are no command. ``enrol``: asks the authority for a robot's certificate.
"""

import argparse
import base64
import json
import math
import socket
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from safedpa.bus import ZenohSettings, ZenohTransport
from safedpa.bus.messages.codec import decode, encode
from safedpa.bus.messages.messages import ActionMessage, StateMessage
from safedpa.bus.security.certificate_authority import Authority
from safedpa.bus.security.certificates import Certificates
from safedpa.errors import MessageError, SafedpaError

SECONDS = 3.0
LONGEST_SECONDS = 30.0
TICK_SECONDS = 0.05
Send = Callable[[str, bytes], None]


def enter(options: argparse.Namespace) -> dict[str, Any]:
    """Without any certificate, in plain text, or with one of a foreign authority under the filter's name."""
    import zenoh

    configuration = zenoh.Config()
    protocol = "tcp" if options.how == "plain" else "tls"
    tls = {"root_ca_certificate": "/certificates/authority.pem", "verify_name_on_connect": True}
    if options.how == "foreign":
        folder = Path("/tmp/foreign")
        Authority(folder, "fleet").issue("safety_filter", 1.0)
        tls["connect_certificate"] = str(folder / "safety_filter.pem")
        tls["connect_private_key"] = str(folder / "safety_filter.key.pem")
        tls["enable_mtls"] = True
    settings = {
        "mode": "client",
        "connect/endpoints": [f"{protocol}/router:7447"],
        "connect/timeout_ms": 3000,
        "connect/exit_on_failure": True,
        "scouting/multicast/enabled": False,
        **({} if options.how == "plain" else {"transport/link/tls": tls}),
    }
    for path, value in settings.items():
        configuration.insert_json5(path, json.dumps(value))
    try:
        session = zenoh.open(configuration)
    except zenoh.ZError as error:
        return {"opened": False, "notice": str(error)[:200]}
    session.put(f"safedpa/fleet/{options.robot}/action", _action(options.epoch, options.tick))
    session.close()
    return {"opened": True}


def capture(transport: ZenohTransport, robot: str) -> dict[str, Any]:
    heard: list[tuple[str, str]] = []

    def keep(key: str, payload: bytes) -> None:
        heard.append((key, base64.b64encode(payload).decode()))

    for topic in ("action", "state", "verdict", "model"):
        transport.subscribe(f"safedpa/fleet/*/{topic}", keep)
    time.sleep(SECONDS)
    end, wanted = time.monotonic() + LONGEST_SECONDS, f"safedpa/fleet/{robot}/action"
    while wanted not in {key for key, _ in list(heard)} and time.monotonic() < end:  # it may brake by itself for long
        time.sleep(TICK_SECONDS)
    return {"heard": list(heard)}


def act(options: argparse.Namespace, transport: ZenohTransport, send: Send) -> int:
    """A command for every state that is heard, at once: before the filter has decided; under a wildcard as well."""
    states: SimpleQueue[bytes] = SimpleQueue()
    transport.subscribe(f"safedpa/fleet/{options.robot}/state", lambda _key, payload: states.put(payload))
    values = (0.0, 0.0) if options.how == "brake" else (4.0, 0.3)
    sent, end = 0, time.monotonic() + SECONDS
    while (rest := end - time.monotonic()) > 0.0:
        try:
            state = decode(StateMessage, states.get(timeout=rest))
        except Empty:
            break
        except MessageError:  # its own forgery, which its own session hears
            continue
        for place in (options.robot, "*"):
            send(f"safedpa/fleet/{place}/{options.topic}", _action(state.epoch, state.tick, values))
            sent += 1
    return sent


def _action(epoch: int, tick: int, values: tuple[float, ...] = (4.0, 0.3)) -> bytes:
    return encode(ActionMessage(epoch=epoch, tick=tick, robot_time=0.0, publish_time=time.time(), values=values))


def replay(send: Send) -> int:
    captured = json.loads(sys.stdin.readline())["heard"]
    for _ in range(3):
        for key, payload in captured:
            send(key, base64.b64decode(payload))
    return 3 * len(captured)


def malformed(options: argparse.Namespace) -> Iterator[bytes]:
    """Everything that is no action: noise, cut off, foreign types, too many numbers, not finite, other messages."""
    good = _action(options.epoch, options.tick + 20)
    yield from (b"", b"\x00", b"\xc1" * 64, bytes(range(256)), good[:-3], good + good)
    yield _action(options.epoch, options.tick + 20, (4.0, 0.3, 1.0, 1.0))
    yield good.replace(b"values", b"valued")
    for bad in (math.nan, math.inf, 1e300):
        yield good.replace(_double(4.0), _double(bad))
    yield b"\xdd\xff\xff\xff\xff" + good  # an array that says it has four thousand million entries


def _double(number: float) -> bytes:
    import struct

    return b"\xcb" + struct.pack(">d", number)


def enrol(address: str) -> dict[str, Any]:
    """A request for a robot's certificate from a container that is none."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import NameOID

    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "robot.robot-1")])
    request = x509.CertificateSigningRequestBuilder().subject_name(name)
    signed = request.sign(ec.generate_private_key(ec.SECP256R1()), hashes.SHA256())
    with socket.create_connection((address, 7448), 5.0) as connection:
        connection.sendall(signed.public_bytes(serialization.Encoding.PEM))
        connection.shutdown(socket.SHUT_WR)
        return {"got": connection.recv(4096).decode()}


def _on_the_bus(options: argparse.Namespace) -> dict[str, Any]:
    certificates = Certificates(Path("/certificates"), options.role)
    transport = ZenohTransport(ZenohSettings("client", (), ("tls/router:7447",), certificates))

    def send(key: str, payload: bytes) -> None:
        transport.put(key, payload, never_drop=False)

    try:
        if options.what == "capture":
            return capture(transport, options.robot)
        if options.what == "act":
            return {"sent": act(options, transport, send)}
        if options.what == "replay":
            return {"sent": replay(send)}
        payloads = [bytes(1_000_000)] * 5 if options.what == "large" else list(malformed(options))
        for payload in payloads:
            send(f"safedpa/fleet/{options.robot}/{options.topic}", payload)
            time.sleep(TICK_SECONDS)
        return {"sent": len(payloads)}
    finally:
        time.sleep(0.5)  # closing the session would drop messages that are still queued
        transport.close()


def main() -> None:
    parser = argparse.ArgumentParser(prog="fleet-intruder")
    parser.add_argument("what", choices=("enter", "capture", "act", "replay", "large", "malformed", "enrol"))
    parser.add_argument("--how", default="")
    parser.add_argument("--role", default="")
    parser.add_argument("--robot", default="robot-1")
    parser.add_argument("--topic", default="action")
    parser.add_argument("--epoch", type=int, default=0)
    parser.add_argument("--tick", type=int, default=0)
    options = parser.parse_args()
    try:
        if options.what == "enter":
            did = enter(options)
        elif options.what == "enrol":
            did = enrol("authority")
        else:
            did = _on_the_bus(options)
    except (OSError, SafedpaError) as error:
        did = {"error": str(error)}
    sys.stdout.write(json.dumps(did) + "\n")


if __name__ == "__main__":
    main()
