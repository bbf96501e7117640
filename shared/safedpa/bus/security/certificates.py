"""The credentials of a process on a secured bus: certificates in a folder, or in memory.

The folder has ``authority.pem``, whose signature a process trusts, ``ROLE.pem`` and ``ROLE.key.pem``. The common name
in a certificate is the role; that of a robot is ``robot.NAME``. ``safedpa certificates`` creates the files.

With ``safedpa up --secure`` no key is stored in a file. A process receives ``PemCredentials`` through a pipe instead.
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

AUTHORITY = "authority"
# Bytes of credentials read from a pipe, as many as a pipe holds.
_MOST_BYTES = 1 << 16
_PR_SET_DUMPABLE = 4  # of <sys/prctl.h>


@dataclass(frozen=True)
class Certificates:
    """The three files with which a process authenticates.

    Raises BusError at construction if one of them is missing or unreadable.
    """

    folder: Path
    role: str

    def __post_init__(self) -> None:
        if not self.role:
            raise BusError(
                f"--certificates {self.folder}: --role is missing, wanted the role of the certificate, such as robot.r1"
            )
        # Checked here, because Zenoh's own error for an unreadable file does not name the file.
        for path in (self.authority, self.certificate, self.key):
            if not os.access(path, os.R_OK):
                raise BusError(
                    f"{path}: {'cannot be read by this user' if path.exists() else 'does not exist'}; create it with "
                    f"'safedpa certificates {self.folder}', and give each process only its own key"
                )
        # A warning and no error: mounted volumes often show such modes and cannot be changed.
        if self.key.stat().st_mode & 0o007:
            log_event(
                "bus.key_exposed",
                f"{self.key}: every user of this machine can read or write this key and act as {self.role}; "
                "use chmod 600",
                level="warning",
                service=self.role,
            )

    @property
    def authority(self) -> Path:
        """Certificate of the authority whose signature this process trusts."""
        return self.folder / f"{AUTHORITY}.pem"

    @property
    def certificate(self) -> Path:
        """This process's own certificate."""
        return self.folder / f"{self.role}.pem"

    @property
    def key(self) -> Path:
        """The private key of the certificate."""
        return self.folder / f"{self.role}.key.pem"

    def tls(self) -> dict[str, str]:
        """Returns Zenoh's settings for these files."""
        return _tls_settings(str(self.authority), str(self.certificate), str(self.key))


@final
@dataclass(frozen=True)
class PemCredentials:
    """The same three in PEM format in memory, so that the key is in no file."""

    role: str
    authority: bytes
    certificate: bytes
    key: bytes = field(repr=False)

    @classmethod
    def of(cls, folder: Path, role: str) -> PemCredentials:
        """Reads the files of a role. Raises OSError if that fails."""
        files = Certificates(folder, role)
        return cls(role, *(path.read_bytes() for path in (files.authority, files.certificate, files.key)))

    @classmethod
    def from_descriptor(cls, descriptor: int, role: str) -> PemCredentials:
        """Reads what ``pipe`` wrote, and closes the descriptor. Raises BusError for anything else."""
        try:
            with os.fdopen(descriptor, "rb") as pipe:
                content = pipe.read(_MOST_BYTES)
        except OSError as error:
            raise BusError(f"--card {descriptor}: {error.strerror}; only a supervisor sets this option") from error
        parts = content.split(b"\0")  # PEM is text without NUL
        if len(parts) != 3 or not all(part.startswith(b"-----BEGIN ") for part in parts):
            raise BusError(
                f"--card {descriptor}: got {len(content)} bytes, wanted authority, certificate and key in PEM format; "
                "only a supervisor sets this option"
            )
        return cls(role, *parts)

    def pipe(self) -> int:
        """Returns a descriptor from which the credentials can be read once."""
        reading, writing = os.pipe()
        try:
            # Does not block although no process reads yet: it is less than a pipe holds. Closing the writing end gives
            # the reader its end of file.
            os.write(writing, b"\0".join((self.authority, self.certificate, self.key)))
        finally:
            os.close(writing)
        return reading

    def tls(self) -> dict[str, str]:
        """Returns Zenoh's settings for these credentials."""
        parts = (base64.b64encode(part).decode() for part in (self.authority, self.certificate, self.key))
        return {f"{name}_base64": value for name, value in _tls_settings(*parts).items()}


def _tls_settings(authority: str, certificate: str, key: str) -> dict[str, str]:
    # The same certificate for both directions: its extended key usage decides whether it may accept connections.
    own = {f"{way}_certificate": certificate for way in ("listen", "connect")}
    return {"root_ca_certificate": authority, **own, **{f"{way}_private_key": key for way in ("listen", "connect")}}


def protect_process_memory() -> bool:
    """Prevents other processes of this user from reading this process's memory, descriptors and environment.

    Also disables core dumps. Returns whether the system supports it (Linux only). A process with CAP_SYS_PTRACE, such
    as root, can still read them.
    """
    # A process that is not dumpable cannot be traced, and its files in /proc belong to root: prctl(2).
    with contextlib.suppress(OSError, AttributeError):
        return bool(ctypes.CDLL(None).prctl(_PR_SET_DUMPABLE, 0, 0, 0, 0) == 0)
    return False
