"""Who a process is on a secured bus: a folder of certificates and a role in it.

The folder holds ``authority.pem`` (whom to believe), ``ROLE.pem`` and ``ROLE.key.pem``; the common name of a
certificate is the role, and that of a robot is ``robot.NAME``. They are made by ``safedpa certificates``.

Where no file should hold a key (``safedpa up --secure``) a process is handed a ``PemCredentials`` by a pipe instead.
"""

from __future__ import annotations

import base64
import contextlib
import ctypes
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import final

from safedpa.bus.logging import log_event
from safedpa.errors import BusError

__all__ = ["AUTHORITY", "Certificates", "PemCredentials", "protect_process_memory"]

AUTHORITY = "authority"
_LONGEST_CARD = 1 << 16
_PR_SET_DUMPABLE = 4


@dataclass(frozen=True)
class Certificates:
    """The three files by which a process proves its role.

    Raises BusError at construction when one of them is missing or cannot be read.
    """

    folder: Path
    role: str

    def __post_init__(self) -> None:
        if not self.role:
            raise BusError(
                f"--certificates {self.folder}: got no --role, wanted whose certificate to show, such as robot.r1"
            )
        for path in (self.authority, self.certificate, self.key):
            if not os.access(path, os.R_OK):
                raise BusError(
                    f"{path}: {'cannot be read by this user' if path.exists() else 'is not there'}; make it with "
                    f"'safedpa certificates {self.folder}', and hand a process its own key alone"
                )
        if self.key.stat().st_mode & 0o007:
            log_event(
                "bus.key_exposed",
                f"{self.key}: every user of this machine can read or write it and pass for {self.role}; chmod 600 it",
                level="warning",
                service=self.role,
            )

    @property
    def authority(self) -> Path:
        """The certificate that signed those of everybody whom this process believes."""
        return self.folder / f"{AUTHORITY}.pem"

    @property
    def certificate(self) -> Path:
        """This process's own."""
        return self.folder / f"{self.role}.pem"

    @property
    def key(self) -> Path:
        """Its private key."""
        return self.folder / f"{self.role}.key.pem"

    def tls(self) -> dict[str, str]:
        """Zenoh's words for them."""
        certificate, key = str(self.certificate), str(self.key)
        return {
            "root_ca_certificate": str(self.authority),
            "listen_private_key": key,
            "listen_certificate": certificate,
            "connect_private_key": key,
            "connect_certificate": certificate,
        }


@final
@dataclass(frozen=True)
class PemCredentials:
    """The same three as PEM in memory: no path leads to the key."""

    role: str
    authority: bytes
    certificate: bytes
    key: bytes = field(repr=False)

    @classmethod
    def of(cls, folder: Path, role: str) -> PemCredentials:
        """What the files of a role hold; OSError where they cannot be read."""
        files = Certificates(folder, role)
        return cls(role, *(path.read_bytes() for path in (files.authority, files.certificate, files.key)))

    @classmethod
    def from_descriptor(cls, descriptor: int, role: str) -> PemCredentials:
        """Reads what ``pipe`` put there, and closes it. Raises BusError for anything else."""
        try:
            with os.fdopen(descriptor, "rb") as pipe:
                notice = pipe.read(_LONGEST_CARD)
        except OSError as error:
            raise BusError(f"--card {descriptor}: {error.strerror}; anyone who starts this process sets it") from error
        parts = notice.split(b"\0")
        if len(parts) != _PARTS or not all(part.startswith(b"-----BEGIN ") for part in parts):
            raise BusError(
                f"--card {descriptor}: got {len(notice)} bytes that are no authority, certificate and key in PEM; only "
                "anyone who starts this process sets it"
            )
        return cls(role, *parts)

    def pipe(self) -> int:
        """A descriptor from which the card can be read once; the reader's end alone stays open."""
        reading, writing = os.pipe()
        try:
            os.write(writing, b"\0".join((self.authority, self.certificate, self.key)))  # less than a pipe holds
        finally:
            os.close(writing)
        return reading

    def tls(self) -> dict[str, str]:
        """Zenoh's words for them."""
        authority, certificate, key = (
            base64.b64encode(part).decode() for part in (self.authority, self.certificate, self.key)
        )
        return {
            "root_ca_certificate_base64": authority,
            "listen_private_key_base64": key,
            "listen_certificate_base64": certificate,
            "connect_private_key_base64": key,
            "connect_certificate_base64": certificate,
        }


_PARTS = 3


def protect_process_memory() -> bool:
    """Keeps other processes of this user out of this one's memory, descriptors and environment, and off core dumps.

    Whether the system knows how (Linux). A process with CAP_SYS_PTRACE, as root has it, reads on.
    """
    with contextlib.suppress(OSError, AttributeError):
        return bool(ctypes.CDLL(None).prctl(_PR_SET_DUMPABLE, 0, 0, 0, 0) == 0)
    return False
