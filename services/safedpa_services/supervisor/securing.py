"""Throw-away certificates for a loop on one machine that runs as it would on several."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from safedpa.bus.access import ROUTER, check_names, roles_of
from safedpa.bus.authority import HOSTS, Authority
from safedpa.errors import InputError

__all__ = ["throw_away_certificates"]

_DAYS = 30.0


@contextmanager
def throw_away_certificates(fleet: str, robot: str) -> Iterator[Path]:
    """A folder, for this user alone, with a certificate for every role; nobody can make another one, and it is removed.

    Raises InputError for names that cannot be a fleet's and a robot's.
    """
    check_names(fleet, (robot,))
    try:
        folder = tempfile.TemporaryDirectory(prefix="safedpa-certificates-")
    except OSError as error:
        raise InputError(f"--secure: no folder for certificates ({error.strerror}); name one by TMPDIR") from error
    with folder as path:
        authority = Authority(Path(path), fleet)
        for role in roles_of((robot,)):
            authority.issue(role, _DAYS, HOSTS if role == ROUTER else ())
        (Path(path) / "authority.key.pem").unlink()
        yield Path(path)
