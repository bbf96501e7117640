"""Certificates for a loop of one command: thrown away afterwards, or a person's own from a folder."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import final

from safedpa.bus.security.access_control import ROUTER, check_names, roles_of
from safedpa.bus.security.certificate_authority import HOSTS, Authority
from safedpa.bus.security.certificates import Certificates, PemCredentials, protect_process_memory
from safedpa.errors import BusError, InputError
from safedpa_services.supervisor.private_folder import private_folder

__all__ = ["OPERATOR", "CertificateStore", "ephemeral_certificates"]

OPERATOR = "operator"
"""Whose files people join with; no process of the loop has to."""
_DAYS = 30.0


@final
@dataclass(frozen=True)
class CertificateStore:
    """A certificate and key for every role, in this process's memory; those of people alone are files too.

    Without ``cards`` all of them are a person's files, and each process reads its own: what is renewed there, or stands
    in the router's ``revoked.txt``, is known while they run.
    """

    folder: Path
    cards: Mapping[str, PemCredentials] = field(default_factory=dict, repr=False)

    def shown(self, role: str) -> tuple[tuple[str, ...], PemCredentials | None]:
        """The options by which a process shows the certificate of its role, and the card that it is handed.

        Raises InputError where the files of the role are not there.
        """
        if self.cards:
            return ("--role", role), self.cards[role]
        self.identity(role)
        return ("--role", role, "--certificates", str(self.folder)), None

    def identity(self, role: str) -> PemCredentials | Certificates:
        """Who this process is where it takes that role. Raises InputError where its files are not there."""
        if self.cards:
            return self.cards[role]
        try:
            return Certificates(self.folder, role)
        except BusError as error:
            raise InputError(f"--certificates: {error}") from error


@contextmanager
def ephemeral_certificates(fleet: str, robot: str) -> Iterator[CertificateStore]:
    """A certificate for every role; no one can make another one, and all are gone however the run ends.

    The folder is for this user alone. Keys of robot and services are in it for the moment in which they are made; then
    this process has them, hands each to its own process, and no other process of this user looks into its memory.
    Raises InputError for names that cannot be a fleet's and a robot's.
    """
    check_names(fleet, (robot,))
    protect_process_memory()
    with private_folder() as folder:
        authority = Authority(folder, fleet)
        (folder / "authority.key.pem").unlink()
        cards = {}
        for role in roles_of((robot,)):
            authority.issue(role, _DAYS, HOSTS if role == ROUTER else ())
            cards[role] = PemCredentials.of(folder, role)
            if role != OPERATOR:
                for name in (f"{role}.pem", f"{role}.key.pem"):
                    (folder / name).unlink()
        del authority  # and its key
        yield CertificateStore(folder, cards)
