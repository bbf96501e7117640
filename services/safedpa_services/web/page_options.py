"""Options of the page server: address, access and allowed folders. Refuses options that would admit everyone."""

from __future__ import annotations

import os
import secrets
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from safedpa.errors import InputError
from safedpa_services.web.hosts import Hosts, is_loopback
from safedpa_services.web.ports import choose_port

TOKEN_VARIABLE = "SAFEDPA_PAGE_TOKEN"
"""Environment variable with the token, for a program that starts the page and prints the address itself."""
PASSWORD_VARIABLE = "SAFEDPA_PAGE_PASSWORD"
"""Environment variable with the password. It is no command option: every user of a machine can read arguments."""
_MIN_SECRET_LENGTH = 12
_DEFAULT_PORT = 8080


@dataclass(frozen=True)
class PageServerOptions:
    """Options of the page server, which ``Guard`` enforces on every request.

    Raises InputError if other machines could open the page without a password or a certificate.
    """

    host: str
    port: int
    names: tuple[str, ...] = ()
    """Further host names under which browsers request the page."""
    folders: tuple[Path, ...] = ()
    """Folders whose recordings may be opened, in addition to those of the recordings on the command line."""
    certificate: Path | None = None
    key: Path | None = None
    token_only: bool = False
    """The user confirms that the token is enough, because the port is mapped to a loopback interface."""
    password: str = field(default_factory=lambda: os.environ.get(PASSWORD_VARIABLE, ""))
    token: str = field(default_factory=lambda: os.environ.get(TOKEN_VARIABLE, "") or secrets.token_urlsafe(24))

    def __post_init__(self) -> None:
        if (self.certificate is None) != (self.key is None):
            raise InputError("--tls-certificate and --tls-key: got one of them, wanted both or none")
        for path in (self.certificate, self.key):
            if path is not None and not os.access(path, os.R_OK):
                raise InputError(f"{path}: cannot be read; wanted a PEM file")
        if self.password and len(self.password) < _MIN_SECRET_LENGTH:
            raise InputError(
                f"{PASSWORD_VARIABLE}: got {len(self.password)} characters, wanted {_MIN_SECRET_LENGTH} or more"
            )
        if len(self.token) < _MIN_SECRET_LENGTH:
            raise InputError(f"{TOKEN_VARIABLE}: got {len(self.token)} characters, wanted {_MIN_SECRET_LENGTH} or more")
        if not (is_loopback(self.host) or self.password or self.certificate or self.token_only):
            raise InputError(
                f"--host {self.host}: every machine that reaches this one could look, accept models and upload; "
                f"wanted a password in {PASSWORD_VARIABLE}, or --tls-certificate and --tls-key; or leave --host out "
                "and connect through 'ssh -L'"
            )

    @classmethod
    def of(cls, options: Mapping[str, Any]) -> PageServerOptions:
        """Takes the options of a command line. Without ``port``, the page gets the first free one from 8080 on."""
        host, names, folders = options["host"], tuple(options["name"]), tuple(options["folder"])
        port = choose_port(options["port"], _DEFAULT_PORT, "--port", host)
        return cls(host, port, names, folders, options["tls_certificate"], options["tls_key"], options["token_only"])

    @property
    def scheme(self) -> str:
        """``https`` with a certificate, else ``http``."""
        return "http" if self.certificate is None else "https"

    @cached_property
    def hosts(self) -> Hosts:
        """The host names under which the page is served."""
        return Hosts(self.host, self.names)

    def address(self, path: str) -> str:
        """The URL of ``path`` that a user opens; it includes the token unless there is a password to obtain it."""
        named = self.names[0] if self.names else "127.0.0.1" if self.host in ("0.0.0.0", "") else self.host
        query = "" if self.password else f"?token={self.token}"
        return f"{self.scheme}://{f'[{named}]' if ':' in named else named}:{self.port}{path}{query}"
