"""Under which names a page may be asked for.

A foreign page can have its own name resolve to this machine (DNS rebinding); the browser then sends that name, and
the answer to it would be readable to the foreign page. So names that no one named are refused. A numeric address
cannot be made to resolve to something else.
"""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Iterable

from safedpa.errors import InputError

__all__ = ["Hosts", "is_loopback"]

_HOST = re.compile(r"(\[[0-9a-fA-F:.]{2,45}\]|[A-Za-z0-9]([A-Za-z0-9.-]{0,251}[A-Za-z0-9])?)(:[0-9]{1,5})?")


def is_loopback(bind: str) -> bool:
    """Whether an address to listen on is reached from this machine alone."""
    return bind == "localhost" or ((address := _address(bind)) is not None and address.is_loopback)


class Hosts:
    """The names by which what listens at ``bind`` is reached, and ``names``. Raises InputError for what is no name."""

    def __init__(self, bind: str, names: Iterable[str] = ()) -> None:
        self._loopback = is_loopback(bind)
        self._names = {"localhost", *(_checked(name) for name in names)}
        if not self._loopback and _address(bind) is None:
            self._names.add(_checked(bind))

    def allow(self, header: str) -> bool:
        """Whether a request with this header ``Host`` is for us."""
        found = _HOST.fullmatch(header)
        if found is None:
            return False
        name = found[1].lower()
        if name in self._names:
            return True
        address = _address(name.strip("[]"))
        return address is not None and (address.is_loopback or not self._loopback)

    def same_origin(self, origin: str, host: str, scheme: str) -> bool:
        """Whether a header ``Origin`` is this very page's."""
        return origin.lower() == f"{scheme}://{host}".lower() and self.allow(host)


def _address(text: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(text)
    except ValueError:
        return None


def _checked(name: str) -> str:
    found = _HOST.fullmatch(name)
    if found is None or found[3]:
        raise InputError(f"--name: got '{name[:80]}', wanted the name of a machine, such as robots.example, no port")
    return found[1].lower()
