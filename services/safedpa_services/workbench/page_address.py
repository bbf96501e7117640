"""Where a page is served and who comes in, as the options say; refuses what would let everybody in."""

from __future__ import annotations

import os
import secrets
from dataclasses import dataclass, field
from pathlib import Path

from safedpa.errors import InputError
from safedpa_services.web.guard import AccessPolicy
from safedpa_services.web.hosts import Hosts, is_loopback

__all__ = ["PASSWORD_VARIABLE", "TOKEN_VARIABLE", "PageServerOptions"]

TOKEN_VARIABLE = "SAFEDPA_PAGE_TOKEN"
"""Environment variable: the token, where anyone who starts the page prints the address itself."""
PASSWORD_VARIABLE = "SAFEDPA_PAGE_PASSWORD"
"""Environment variable: a password that opens the page; arguments can be read by every user of the machine."""
_SHORTEST_PASSWORD = 12


@dataclass(frozen=True)
class PageServerOptions:
    """The options. Raises InputError where other machines could come in without a password or a certificate."""

    host: str
    port: int
    names: tuple[str, ...] = ()
    """Under which the page is also asked for."""
    folders: tuple[Path, ...] = ()
    """From which recordings may be opened, next to those of the recordings that were named."""
    certificate: Path | None = None
    key: Path | None = None
    token_only: bool = False
    """The person says that the token is enough, since the port is mapped to a loopback interface."""
    password: str = field(default_factory=lambda: os.environ.get(PASSWORD_VARIABLE, ""))
    token: str = field(default_factory=lambda: os.environ.get(TOKEN_VARIABLE, "") or secrets.token_urlsafe(24))

    def __post_init__(self) -> None:
        if (self.certificate is None) != (self.key is None):
            raise InputError("--tls-certificate and --tls-key: got one of them, wanted both, or none")
        for path in (self.certificate, self.key):
            if path is not None and not os.access(path, os.R_OK):
                raise InputError(f"{path}: cannot be read; wanted a file in PEM")
        if self.password and len(self.password) < _SHORTEST_PASSWORD:
            raise InputError(f"{PASSWORD_VARIABLE}: got {len(self.password)} letters, wanted {_SHORTEST_PASSWORD}")
        if len(self.token) < _SHORTEST_PASSWORD:
            raise InputError(f"{TOKEN_VARIABLE}: got {len(self.token)} letters, wanted {_SHORTEST_PASSWORD} or more")
        if not (is_loopback(self.host) or self.password or self.certificate or self.token_only):
            raise InputError(
                f"--host {self.host}: every machine that reaches this one could look, accept models and upload; wanted "
                f"a password in {PASSWORD_VARIABLE}, or --tls-certificate and --tls-key; or leave --host out and come "
                "in by 'ssh -L'"
            )

    @property
    def scheme(self) -> str:
        """``https`` with a certificate."""
        return "http" if self.certificate is None else "https"

    @property
    def door(self) -> AccessPolicy:
        """For the guard."""
        return AccessPolicy(Hosts(self.host, self.names), self.port, self.token, self.password, self.scheme)

    def address(self, path: str) -> str:
        """What a person opens, with the token."""
        named = self.names[0] if self.names else "127.0.0.1" if self.host in ("0.0.0.0", "") else self.host
        return self.door.address(f"[{named}]" if ":" in named else named, path)
