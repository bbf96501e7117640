"""A certificate authority of a fleet's own, in a folder: enough for development and for a closed network.

Keys are on the curve P-256 (a handshake costs little), certificates are signed with SHA-256. A certificate of a robot
or a service may open connections; only a router's may also accept them, under the host names written into it.
"""

from __future__ import annotations

import contextlib
import datetime
import ipaddress
import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from safedpa.bus.security.certificates import AUTHORITY
from safedpa.errors import InputError

if TYPE_CHECKING:
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePrivateKey, EllipticCurvePublicKey

__all__ = ["HOSTS", "Authority", "check_days"]

HOSTS = ("localhost", "127.0.0.1", "::1", "router")
"""Names under which a router may be reached unless others are given."""
_AUTHORITY_DAYS = 3650
_LARGEST_DAYS = 3650
_SKEW = datetime.timedelta(minutes=5)
"""Clocks of robots differ; a certificate is good from so long before it was made."""


class Authority:
    """The authority of one fleet, kept in ``folder``; made there if there is none.

    Raises InputError when the folder cannot be written, or holds the authority of another fleet.
    """

    def __init__(self, folder: Path, fleet: str) -> None:
        self.folder, self.fleet = folder, fleet
        with _readable_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
            self.is_new = not (folder / f"{AUTHORITY}.key.pem").exists()
            if self.is_new:
                self._make()
            self._key, self._certificate = self._load()

    def issue(self, role: str, days: float, hosts: tuple[str, ...] = ()) -> Path:
        """Writes ``ROLE.pem`` and ``ROLE.key.pem``, good for ``days``; with ``hosts`` it may accept connections there.

        Returns the certificate's path. Raises InputError for a role that is no file name, or a foolish number of days.
        """
        _check(role, days)
        from cryptography import x509
        from cryptography.hazmat.primitives import hashes

        key = _new_key()
        builder = _builder(_name(role, self.fleet), self._certificate.subject, key.public_key(), days)
        builder = builder.add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        builder = builder.add_extension(_usage(bool(hosts)), critical=False)
        if hosts:
            builder = builder.add_extension(x509.SubjectAlternativeName(_hosts(hosts)), critical=False)
        path = self.folder / f"{role}.pem"
        with _readable_errors(path):
            _write_pair(path, builder.sign(self._key, hashes.SHA256()), key)
        return path

    def sign(self, request: bytes, role: str, days: float) -> bytes:
        """The certificate (PEM) of ``role`` for the key of a certificate signing request (PEM), good for ``days``.

        The names in the request count for nothing: who asks, the caller knows. Raises InputError when it is no request,
        is not signed with the key that it brings, or that key is none on P-256.
        """
        _check(role, days)
        from cryptography import x509
        from cryptography.hazmat.primitives import hashes

        key = _key_of(request)
        builder = _builder(_name(role, self.fleet), self._certificate.subject, key, days)
        builder = builder.add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        builder = builder.add_extension(_usage(False), critical=False)
        return _pem(builder.sign(self._key, hashes.SHA256()))

    def _make(self) -> None:
        from cryptography import x509
        from cryptography.hazmat.primitives import hashes

        key = _new_key()
        name = _name(f"{self.fleet} authority", self.fleet)
        builder = _builder(name, name, key.public_key(), _AUTHORITY_DAYS)
        builder = builder.add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        _write_pair(self.folder / f"{AUTHORITY}.pem", builder.sign(key, hashes.SHA256()), key)

    def _load(self) -> tuple[EllipticCurvePrivateKey, x509.Certificate]:
        from cryptography import x509
        from cryptography.hazmat.primitives import serialization
        from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePrivateKey

        path = self.folder / f"{AUTHORITY}.pem"
        try:
            certificate = x509.load_pem_x509_certificate(path.read_bytes())
            key = serialization.load_pem_private_key((self.folder / f"{AUTHORITY}.key.pem").read_bytes(), None)
        except (ValueError, TypeError) as error:
            raise InputError(f"{path}: no certificate and key of an authority; choose another folder") from error
        if not isinstance(key, EllipticCurvePrivateKey):
            raise InputError(f"{path}: got another kind of key, wanted one on P-256; choose another folder")
        fleet = _fleet_of(certificate)
        if fleet != self.fleet:
            raise InputError(
                f"{path}: is the authority of fleet '{fleet}', wanted '{self.fleet}': anyone who belongs to one fleet "
                "would belong to the other; choose another folder"
            )
        return key, certificate


def _fleet_of(certificate: x509.Certificate) -> str:
    from cryptography.x509.oid import NameOID

    return "".join(str(part.value) for part in certificate.subject.get_attributes_for_oid(NameOID.ORGANIZATION_NAME))


def _check(role: str, days: float) -> None:
    if not role or role == AUTHORITY or not all(letter.isalnum() or letter in "-_." for letter in role):
        raise InputError(f"role '{role}': wanted letters, digits, '-', '_' or '.', and not '{AUTHORITY}'")
    check_days(days)


def check_days(days: float) -> None:
    """Raises InputError for a foolish time [days] that a certificate shall be good."""
    if not 0.0 < days <= _LARGEST_DAYS:
        raise InputError(f"--days: got {days:g}, wanted more than 0 and at most {_LARGEST_DAYS}")


def _new_key() -> EllipticCurvePrivateKey:
    from cryptography.hazmat.primitives.asymmetric import ec

    return ec.generate_private_key(ec.SECP256R1())


def _key_of(request: bytes) -> EllipticCurvePublicKey:
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric.ec import SECP256R1, EllipticCurvePublicKey

    wanted = "wanted a certificate signing request in PEM, signed with its own key on P-256"
    try:
        asked = x509.load_pem_x509_csr(request)
        key = asked.public_key()
    except ValueError as error:
        raise InputError(f"request: got {len(request)} bytes that are none; {wanted}") from error
    if not isinstance(key, EllipticCurvePublicKey) or not isinstance(key.curve, SECP256R1):
        raise InputError(f"request: got another kind of key; {wanted}")
    if not asked.is_signature_valid:
        raise InputError(f"request: its signature does not fit its key; {wanted}")
    return key


def _name(common: str, fleet: str) -> x509.Name:
    from cryptography import x509
    from cryptography.x509.oid import NameOID

    return x509.Name(
        [x509.NameAttribute(NameOID.ORGANIZATION_NAME, fleet), x509.NameAttribute(NameOID.COMMON_NAME, common)]
    )


def _builder(subject: x509.Name, issuer: x509.Name, key: EllipticCurvePublicKey, days: float) -> Any:
    from cryptography import x509

    now = datetime.datetime.now(datetime.UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _SKEW)
        .not_valid_after(now + datetime.timedelta(days=days))
    )


def _usage(accepts: bool) -> x509.ExtendedKeyUsage:
    from cryptography import x509
    from cryptography.x509.oid import ExtendedKeyUsageOID

    server = [ExtendedKeyUsageOID.SERVER_AUTH] if accepts else []
    return x509.ExtendedKeyUsage([ExtendedKeyUsageOID.CLIENT_AUTH, *server])


def _hosts(hosts: tuple[str, ...]) -> list[x509.GeneralName]:
    from cryptography import x509

    names: list[x509.GeneralName] = []
    for host in dict.fromkeys(hosts):
        try:
            names.append(x509.IPAddress(ipaddress.ip_address(host)))
        except ValueError:
            names.append(x509.DNSName(host))
    return names


def _write_pair(path: Path, certificate: x509.Certificate, key: EllipticCurvePrivateKey) -> None:
    """The key first, and each file whole or not at all: a process may be reading them."""
    from cryptography.hazmat.primitives import serialization

    private = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    _write(path.with_suffix(".key.pem"), private, 0o600)
    _write(path, _pem(certificate), 0o644)


def _pem(certificate: x509.Certificate) -> bytes:
    from cryptography.hazmat.primitives import serialization

    return certificate.public_bytes(serialization.Encoding.PEM)


def _write(path: Path, content: bytes, mode: int) -> None:
    new = path.with_name(f"{path.name}.new")
    new.unlink(missing_ok=True)
    descriptor = os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
    with os.fdopen(descriptor, "wb") as file:
        file.write(content)
    new.replace(path)


@contextlib.contextmanager
def _readable_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}; choose another folder") from error
