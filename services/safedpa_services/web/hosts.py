"""Host names under which a page is served: protection against DNS rebinding.

A foreign page can make its own host name resolve to this machine. The browser then sends that name, and the foreign
page could read the answer. Requests for unknown host names are therefore refused. Numeric addresses cannot be rebound.
"""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Iterable

from safedpa.errors import InputError

_HOST = re.compile(r"(\[[0-9a-fA-F:.]{2,45}\]|[A-Za-z0-9]([A-Za-z0-9.-]{0,251}[A-Za-z0-9])?)(:[0-9]{1,5})?")


def is_loopback(bind: str) -> bool:
    """Returns whether an address to listen on can be reached from this machine only."""
    return bind == "localhost" or ((address := _address(bind)) is not None and address.is_loopback)


class Hosts:
    """The allowed host names of a server at ``bind``, including ``names``. Raises InputError for an invalid name."""

    def __init__(self, bind: str, names: Iterable[str] = ()) -> None:
        self._loopback = is_loopback(bind)
        self._names = {"localhost", *(_checked(name) for name in names)}
        if not self._loopback and _address(bind) is None:
            self._names.add(_checked(bind))

    def allow(self, header: str) -> bool:
        """Returns whether a request with this ``Host`` header is allowed."""
        found = _HOST.fullmatch(header)
        if found is None:
            return False
        name = found[1].lower()
        if name in self._names:
            return True
        address = _address(name.strip("[]"))
        return address is not None and (address.is_loopback or not self._loopback)

    @staticmethod
    def without_port(header: str) -> str:
        """Returns the host name in an allowed ``Host`` header."""
        found = _HOST.fullmatch(header)
        return found[1] if found else "localhost"

    def same_origin(self, origin: str, host: str, scheme: str) -> bool:
        """Returns whether an ``Origin`` header is that of this page."""
        return origin.lower() == f"{scheme}://{host}".lower() and self.allow(host)


def _address(text: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(text)
    except ValueError:
        return None


def _checked(name: str) -> str:
    found = _HOST.fullmatch(name)
    if found is None or found[3]:
        raise InputError(f"--name: got '{name[:80]}', wanted a host name without port, such as robots.example")
    return found[1].lower()
