"""Certificates for the processes of one run: temporary ones, or the user's own from a folder."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import final

from safedpa.bus.security.access_control import ROUTER, check_names, roles_of
from safedpa.bus.security.certificates import Certificates, PemCredentials, protect_process_memory
from safedpa.errors import BusError, InputError
from safedpa_services.supervisor.private_folder import private_folder

OPERATOR = "operator"
"""Role of people who join the bus; no process of the loop needs its files."""
_DAYS = 30.0


@final
@dataclass(frozen=True)
class CertificateStore:
    """A certificate and key for every role.

    With ``credentials`` they are in this process's memory; only the operator's are files, in ``folder``. Without, all
    are files of the user in ``folder``. Each process reads its own files, so renewed certificates and the router's
    ``revoked.txt`` take effect during the run.
    """

    folder: Path
    credentials: Mapping[str, PemCredentials] = field(default_factory=dict, repr=False)

    def options_of(self, role: str) -> tuple[tuple[str, ...], PemCredentials | None]:
        """Returns the command-line options of a role, and the credentials to pass through a pipe, if any.

        Raises InputError if the files of the role do not exist.
        """
        if self.credentials:
            return ("--role", role), self.credentials[role]
        self.identity(role)
        return ("--role", role, "--certificates", str(self.folder)), None

    def identity(self, role: str) -> PemCredentials | Certificates:
        """Returns the credentials of a role for this process. Raises InputError if its files do not exist."""
        if self.credentials:
            return self.credentials[role]
        try:
            return Certificates(self.folder, role)
        except BusError as error:
            raise InputError(f"--certificates: {error}") from error


@contextmanager
def ephemeral_certificates(fleet: str, robot: str) -> Iterator[CertificateStore]:
    """Yields temporary certificates for every role; they are deleted however the run ends.

    The key of the authority is never kept, so no further certificate can be issued. The keys of robot and services are
    on disk only while they are created, in a folder that only this user can read. After that they are in the memory of
    this process, which other processes of the user cannot read, and it passes each to its own process.
    Raises InputError for invalid names of fleet or robot.
    """
    from safedpa.bus.security.certificate_authority import HOSTS, Authority  # imports cryptography, which is slow

    check_names(fleet, (robot,))
    protect_process_memory()
    with private_folder() as folder:
        authority = Authority(folder, fleet)
        (folder / "authority.key.pem").unlink()
        credentials = {}
        for role in roles_of((robot,)):
            authority.issue(role, _DAYS, HOSTS if role == ROUTER else ())
            credentials[role] = PemCredentials.of(folder, role)
            if role != OPERATOR:
                for name in (f"{role}.pem", f"{role}.key.pem"):
                    (folder / name).unlink()
        del authority  # drops the last copy of its key
        yield CertificateStore(folder, credentials)
