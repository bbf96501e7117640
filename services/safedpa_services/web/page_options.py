"""Options of the page server: address, access and allowed folders. Refuses options that would admit everyone."""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import stat
import tempfile
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
TOKEN_FILE = "page-token"
"""File of a session's folder with its token, for its user alone."""
_MIN_SECRET_LENGTH = 12
_LONGEST_TOKEN = 256
_TOKEN = re.compile(r"[A-Za-z0-9_-]{24,128}")
_DEFAULT_PORT = 8080


def kept_token(folder: Path) -> str:
    """Returns the token that ``keep_token`` has stored in a session's folder, else a new one.

    Open tabs thereby go on after a restart. A file that another user could have read or written does not count.
    """
    path = folder / TOKEN_FILE
    with contextlib.suppress(OSError), open(os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)) as file:
        status = os.fstat(file.fileno())
        private = stat.S_ISREG(status.st_mode) and not status.st_mode & 0o077 and status.st_uid == os.geteuid()
        if private and _TOKEN.fullmatch(token := file.read(_LONGEST_TOKEN)):
            return token
    return secrets.token_urlsafe(24)


def keep_token(folder: Path, token: str) -> None:
    """Stores the token for this user alone; without a folder that can be written, it is of this start alone."""
    if kept_token(folder) == token:
        return
    with contextlib.suppress(OSError):
        folder.mkdir(0o700, parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=TOKEN_FILE, dir=folder)  # created with mode 0600
        with os.fdopen(handle, "w", encoding="ascii") as written:
            written.write(token)
        os.replace(name, folder / TOKEN_FILE)


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
        """Takes the options of a command line. Without ``port``, the page gets the first free one from 8080 on.

        The token is that of the environment, or that of earlier starts with the same folder ``out``.
        """
        host, names, folders = options["host"], tuple(options["name"]), tuple(options["folder"])
        port = choose_port(options["port"], _DEFAULT_PORT, "--port", host)
        token = os.environ.get(TOKEN_VARIABLE, "") or kept_token(Path(options["out"]))
        certificate, key = options["tls_certificate"], options["tls_key"]
        return cls(host, port, names, folders, certificate, key, options["token_only"], token=token)

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
