"""Who a process is on a secured bus: a folder of certificates and a role in it.

The folder holds ``authority.pem`` (whom to believe), ``ROLE.pem`` and ``ROLE.key.pem``; the common name of a
certificate is the role, and that of a robot is ``robot.NAME``. They are made by ``safedpa certificates``.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from safedpa.bus.log import log_event
from safedpa.errors import BusError

__all__ = ["AUTHORITY", "Certificates"]

AUTHORITY = "authority"


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
