"""Throw-away certificates for a loop on one machine that runs as it would on several."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import final

from safedpa.bus.access import ROUTER, check_names, roles_of
from safedpa.bus.authority import HOSTS, Authority
from safedpa.bus.certificates import Card, close_memory
from safedpa_services.supervisor.private_folder import private_folder

__all__ = ["OPERATOR", "Wallet", "throw_away_certificates"]

OPERATOR = "operator"
"""Whose files people join with; no process of the loop has to."""
_DAYS = 30.0


@final
@dataclass(frozen=True)
class Wallet:
    """A certificate and key for every role, in this process's memory; those of people alone are files too."""

    folder: Path
    cards: Mapping[str, Card] = field(repr=False)


@contextmanager
def throw_away_certificates(fleet: str, robot: str) -> Iterator[Wallet]:
    """A certificate for every role; nobody can make another one, and all are gone however the run ends.

    The folder is for this user alone. Keys of robot and services are in it for the moment in which they are made; then
    this process has them, hands each to its own process, and no other process of this user looks into its memory.
    Raises InputError for names that cannot be a fleet's and a robot's.
    """
    check_names(fleet, (robot,))
    close_memory()
    with private_folder() as folder:
        authority = Authority(folder, fleet)
        (folder / "authority.key.pem").unlink()
        cards = {}
        for role in roles_of((robot,)):
            authority.issue(role, _DAYS, HOSTS if role == ROUTER else ())
            cards[role] = Card.of(folder, role)
            if role != OPERATOR:
                for name in (f"{role}.pem", f"{role}.key.pem"):
                    (folder / name).unlink()
        del authority  # and its key
        yield Wallet(folder, cards)
