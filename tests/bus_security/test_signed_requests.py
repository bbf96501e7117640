"""What an authority signs for others: keys on P-256 only, signed by their owner, under the caller's name."""

import base64
import datetime
from pathlib import Path
from typing import Any

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec, ed25519, rsa
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from safedpa.bus.security.certificate_authority import Authority
from safedpa.errors import InputError

MAKERS = {
    "P-384": lambda: ec.generate_private_key(ec.SECP384R1()),
    "P-521": lambda: ec.generate_private_key(ec.SECP521R1()),
    "secp256k1": lambda: ec.generate_private_key(ec.SECP256K1()),
    "RSA": lambda: rsa.generate_private_key(65537, 2048),
    "Ed25519": ed25519.Ed25519PrivateKey.generate,
}


def request_of(key: Any, name: str = "authority") -> bytes:
    """In PEM; asks for a name that anyone who signs need not give."""
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    algorithm = None if isinstance(key, ed25519.Ed25519PrivateKey) else hashes.SHA256()
    asked = x509.CertificateSigningRequestBuilder().subject_name(subject).sign(key, algorithm)
    return asked.public_bytes(serialization.Encoding.PEM)


@pytest.mark.parametrize("kind", MAKERS)
def test_another_kind_of_key_is_refused(kind: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"got another kind of key; wanted .* on P-256"):
        Authority(tmp_path, "f").sign(request_of(MAKERS[kind]()), "policy", 1.0)


def test_a_request_that_another_key_signed_is_refused(tmp_path: Path) -> None:
    """The key in it is replaced by one of another owner."""
    mine, other = ec.generate_private_key(ec.SECP256R1()), ec.generate_private_key(ec.SECP256R1())
    point = [
        key.public_key().public_bytes(serialization.Encoding.X962, serialization.PublicFormat.UncompressedPoint)
        for key in (mine, other)
    ]
    lines = request_of(mine).decode().splitlines()
    content = base64.b64decode("".join(lines[1:-1]))
    forged = base64.encodebytes(content.replace(point[0], point[1])).decode()
    with pytest.raises(InputError, match="its signature does not match its key"):
        Authority(tmp_path, "f").sign(f"{lines[0]}\n{forged}{lines[-1]}\n".encode(), "policy", 1.0)


@pytest.mark.parametrize("days", [0.5, 90.0])
def test_a_signed_certificate_is_the_callers_role_for_so_many_days_and_connects_only(days: float, tmp_path: Path):
    authority, key = Authority(tmp_path, "f"), ec.generate_private_key(ec.SECP256R1())
    before = datetime.datetime.now(datetime.UTC).replace(microsecond=0)
    made = x509.load_pem_x509_certificate(authority.sign(request_of(key), "policy", days))
    after = datetime.datetime.now(datetime.UTC)
    made.verify_directly_issued_by(x509.load_pem_x509_certificate((tmp_path / "authority.pem").read_bytes()))
    assert made.public_key() == key.public_key()
    assert [str(part.value) for part in made.subject] == ["f", "policy"]
    lasts = datetime.timedelta(days=days)
    assert before + lasts <= made.not_valid_after_utc <= after + lasts
    assert made.not_valid_after_utc - made.not_valid_before_utc == lasts + datetime.timedelta(minutes=5)
    usage = made.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
    assert list(usage) == [ExtendedKeyUsageOID.CLIENT_AUTH]
    assert not made.extensions.get_extension_for_class(x509.BasicConstraints).value.ca


@pytest.mark.parametrize("role", ["", "authority", "a/b", "../policy"])
def test_a_role_that_is_none_is_refused(role: str, tmp_path: Path) -> None:
    request = request_of(ec.generate_private_key(ec.SECP256R1()))
    with pytest.raises(InputError, match="wanted letters, digits"):
        Authority(tmp_path, "f").sign(request, role, 1.0)


def test_what_is_issued_again_takes_the_place_of_what_was_there_and_leaves_nothing_else(tmp_path: Path) -> None:
    authority = Authority(tmp_path, "f")
    first = authority.issue("policy", 1.0).read_bytes()
    second = authority.issue("policy", 2.0).read_bytes()
    assert first != second
    certificate = x509.load_pem_x509_certificate(second)
    key = serialization.load_pem_private_key((tmp_path / "policy.key.pem").read_bytes(), None)
    assert key.public_key() == certificate.public_key()
    assert {path.name for path in tmp_path.iterdir()} == {
        f"{name}{end}" for name in ("authority", "policy") for end in (".pem", ".key.pem")
    }
