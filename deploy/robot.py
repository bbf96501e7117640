"""Starts the simulated robot of this container under a name that stays the same when the container starts again.

A scaled service has one command for all its containers. So the robot asks the network's name service for the name of
its own address, ``PROJECT_robot_3``, and is ``robot-3`` from then on; SAFEDPA_NAME in the environment overrules that.
The name is kept in /tmp/name for the health check. Its load and its scene come from the number: SAFEDPA_LOAD may name
several loads, separated by commas, which the robots take in turn; SAFEDPA_SEED is the first robot's scene. With
SAFEDPA_LASER=1 they are given no obstacles and have a laser: someone has to run perception.
With ``--certificates DIR`` it makes a key there, unless there is one, and has it signed by the authority; see
authority.py. Every argument is handed on to ``python -m safedpa_sim.robots``.
"""

from __future__ import annotations

import os
import socket
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from container_name import container_at, number_in

NAME_FILE = Path("/tmp/name")
AUTHORITY = ("authority", 7448)
TRUSTED = Path("/healthcheck/authority.pem")
_PATIENCE_SECONDS = 5.0


def command(environment: Mapping[str, str], name: str, arguments: Sequence[str]) -> list[str]:
    """The command line of the robot called ``name``."""
    turn = number_in(name) - 1
    loads = environment.get("SAFEDPA_LOAD", "box").split(",")
    seed = int(environment.get("SAFEDPA_SEED", "0")) + turn
    options = ["--name", name, "--load", loads[turn % len(loads)].strip(), "--seed", str(seed)]
    options += ["--laser"] if environment.get("SAFEDPA_LASER", "") not in ("", "0") else []
    role = ["--role", f"robot.{name}"] if "--certificates" in arguments else []
    return [sys.executable, "-m", "safedpa_sim.robots", *options, *role, *arguments]


def enrol(role: str, folder: Path) -> None:
    """Makes a key that never leaves this container and gets its certificate. Raises OSError when no one signs it.

    ``folder`` must be this container's own. Whom to believe, ``authority.pem``, is copied there from the volume that
    the authority filled, so that no one on the network can stand in for it.
    """
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    folder.mkdir(mode=0o700, exist_ok=True)
    if (folder / f"{role}.pem").exists():
        return
    key = ec.generate_private_key(ec.SECP256R1())
    request = x509.CertificateSigningRequestBuilder().subject_name(x509.Name([])).sign(key, hashes.SHA256())
    with socket.create_connection(AUTHORITY, _PATIENCE_SECONDS) as connection, connection.makefile("rb") as answer:
        connection.sendall(request.public_bytes(serialization.Encoding.PEM))
        connection.shutdown(socket.SHUT_WR)
        certificate = answer.read()
    if not certificate:
        raise OSError(f"{role}: the authority signed nothing; see its log")
    private = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    descriptor = os.open(folder / f"{role}.key.pem", os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
    with os.fdopen(descriptor, "wb") as file:
        file.write(private)
    (folder / "authority.pem").write_bytes(TRUSTED.read_bytes())
    (folder / f"{role}.pem").write_bytes(certificate)


def main() -> None:
    """Becomes the robot."""
    arguments = sys.argv[1:]
    own_address = socket.gethostbyname(socket.gethostname())
    name = os.environ.get("SAFEDPA_NAME") or f"robot-{number_in(container_at(own_address))}"
    NAME_FILE.write_text(name, encoding="utf-8")
    phrase = command(os.environ, name, arguments)
    if "--certificates" in arguments:
        enrol(f"robot.{name}", Path(arguments[arguments.index("--certificates") + 1]))
    os.execv(phrase[0], phrase)


if __name__ == "__main__":
    main()
