"""A certificate authority for one fleet, stored in a folder; sufficient for development and closed networks.

Keys are on the curve P-256, which makes handshakes fast; certificates are signed with SHA-256. With the certificate of
a robot or service, a process may open connections. Only that of a router may also accept them, under its host names.
"""

from __future__ import annotations

import contextlib
import datetime
import ipaddress
import os
from collections.abc import Iterator
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric.ec import (
    SECP256R1,
    EllipticCurvePrivateKey,
    EllipticCurvePublicKey,
    generate_private_key,
)
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat, load_pem_private_key
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from safedpa.bus.security.certificates import AUTHORITY
from safedpa.errors import InputError

HOSTS = ("localhost", "127.0.0.1", "::1", "router")
"""Default host names and addresses in a router's certificate."""
_LARGEST_DAYS = 3650
# Certificates are valid from this long before they are made, because the clocks of robots differ.
_SKEW = datetime.timedelta(minutes=5)


class Authority:
    """The certificate authority of one fleet in ``folder``; created there if it does not exist.

    Raises InputError if the folder is not writable or has the authority of another fleet.
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
        """Writes ``ROLE.pem`` and ``ROLE.key.pem``, valid for ``days``; returns the path of the certificate.

        With ``hosts``, the certificate may be used to accept connections under these names. Raises InputError for an
        invalid role or number of days.
        """
        key = generate_private_key(SECP256R1())
        certificate = self._signed(key.public_key(), role, days, hosts)
        path = self.folder / f"{role}.pem"
        with _readable_errors(path):
            _write_pair(path, certificate, key)
        return path

    def sign(self, request: bytes, role: str, days: float) -> bytes:
        """Returns a certificate (PEM) of ``role`` for the key in a certificate signing request (PEM).

        Ignores the names in the request; the caller has to know who sent it. Raises InputError if the request is
        malformed, is not signed with its own key, or has a key that is not on P-256.
        """
        return self._signed(_key_of(request), role, days).public_bytes(Encoding.PEM)

    def _signed(
        self, key: EllipticCurvePublicKey, role: str, days: float, hosts: tuple[str, ...] = ()
    ) -> x509.Certificate:
        # The role becomes a file name; the authority's own name would overwrite its certificate.
        if not role or role == AUTHORITY or not all(letter.isalnum() or letter in "-_." for letter in role):
            raise InputError(f"role '{role}': wanted letters, digits, '-', '_' or '.', and not '{AUTHORITY}'")
        check_days(days)
        builder = _builder(_name(role, self.fleet), self._certificate.subject, key, days)
        builder = builder.add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        # Without SERVER_AUTH, a stolen key of a robot cannot be used to impersonate the router.
        usage = [ExtendedKeyUsageOID.CLIENT_AUTH, *([ExtendedKeyUsageOID.SERVER_AUTH] if hosts else [])]
        builder = builder.add_extension(x509.ExtendedKeyUsage(usage), critical=False)
        if hosts:
            builder = builder.add_extension(x509.SubjectAlternativeName(_hosts(hosts)), critical=False)
        return builder.sign(self._key, hashes.SHA256())

    def _make(self) -> None:
        key = generate_private_key(SECP256R1())
        name = _name(f"{self.fleet} authority", self.fleet)
        builder = _builder(name, name, key.public_key(), _LARGEST_DAYS)
        # path_length=0: it signs certificates of processes, but no further authorities.
        builder = builder.add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        _write_pair(self.folder / f"{AUTHORITY}.pem", builder.sign(key, hashes.SHA256()), key)

    def _load(self) -> tuple[EllipticCurvePrivateKey, x509.Certificate]:
        path = self.folder / f"{AUTHORITY}.pem"
        try:
            certificate = x509.load_pem_x509_certificate(path.read_bytes())
            key = load_pem_private_key((self.folder / f"{AUTHORITY}.key.pem").read_bytes(), None)
        except (ValueError, TypeError) as error:
            raise InputError(f"{path}: no certificate and key of an authority; choose another folder") from error
        if not isinstance(key, EllipticCurvePrivateKey):
            raise InputError(f"{path}: got another kind of key, wanted one on P-256; choose another folder")
        # Roles carry no fleet, so one authority for two fleets would let members of one into the other.
        named = certificate.subject.get_attributes_for_oid(NameOID.ORGANIZATION_NAME)
        fleet = "".join(str(part.value) for part in named)
        if fleet != self.fleet:
            raise InputError(
                f"{path}: is the authority of fleet '{fleet}', wanted '{self.fleet}': members of one fleet would be "
                "members of the other; choose another folder"
            )
        return key, certificate


def check_days(days: float) -> None:
    """Raises InputError unless a certificate may be valid for this time [days]."""
    if not 0.0 < days <= _LARGEST_DAYS:
        raise InputError(f"--days: got {days:g}, wanted more than 0 and at most {_LARGEST_DAYS}")


def _key_of(request: bytes) -> EllipticCurvePublicKey:
    wanted = "wanted a certificate signing request in PEM, signed with its own key on P-256"
    try:
        asked = x509.load_pem_x509_csr(request)
        key = asked.public_key()
    except ValueError as error:
        raise InputError(f"request: got {len(request)} bytes that are not a request; {wanted}") from error
    if not isinstance(key, EllipticCurvePublicKey) or not isinstance(key.curve, SECP256R1):
        raise InputError(f"request: got another kind of key; {wanted}")
    # The signature proves that the sender has the private key, and did not copy another one's public key.
    if not asked.is_signature_valid:
        raise InputError(f"request: its signature does not match its key; {wanted}")
    return key


def _name(common: str, fleet: str) -> x509.Name:
    parts = ((NameOID.ORGANIZATION_NAME, fleet), (NameOID.COMMON_NAME, common))
    return x509.Name([x509.NameAttribute(*part) for part in parts])


def _builder(
    subject: x509.Name, issuer: x509.Name, key: EllipticCurvePublicKey, days: float
) -> x509.CertificateBuilder:
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


def _hosts(hosts: tuple[str, ...]) -> list[x509.GeneralName]:
    names: list[x509.GeneralName] = []
    for host in dict.fromkeys(hosts):
        try:
            names.append(x509.IPAddress(ipaddress.ip_address(host)))
        except ValueError:
            names.append(x509.DNSName(host))
    return names


def _write_pair(path: Path, certificate: x509.Certificate, key: EllipticCurvePrivateKey) -> None:
    """Writes the key, then the certificate."""
    # Each file atomically, because a process may be reading them; the key first, so that a process that finds a new
    # role's certificate also finds its key.
    private = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    _write(path.with_suffix(".key.pem"), private, 0o600)
    _write(path, certificate.public_bytes(Encoding.PEM), 0o644)


def _write(path: Path, content: bytes, mode: int) -> None:
    new = path.with_name(f"{path.name}.new")
    new.unlink(missing_ok=True)
    # Created with its final mode: chmod after writing would leave the key readable for a moment. O_EXCL does not follow
    # a link that another user placed there.
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
