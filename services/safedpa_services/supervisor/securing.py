"""Throw-away certificates for a loop on one machine that runs as it would on several."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from safedpa.bus.access import ROUTER, check_names, roles_of
from safedpa.bus.authority import HOSTS, Authority
from safedpa_services.supervisor.private_folder import private_folder

__all__ = ["throw_away_certificates"]

_DAYS = 30.0


@contextmanager
def throw_away_certificates(fleet: str, robot: str) -> Iterator[Path]:
    """A folder, for this user alone, with a certificate for every role; nobody can make another one, and it is
    removed however the run ends.

    Raises InputError for names that cannot be a fleet's and a robot's.
    """
    check_names(fleet, (robot,))
    with private_folder() as folder:
        authority = Authority(folder, fleet)
        for role in roles_of((robot,)):
            authority.issue(role, _DAYS, HOSTS if role == ROUTER else ())
        (folder / "authority.key.pem").unlink()
        yield folder
