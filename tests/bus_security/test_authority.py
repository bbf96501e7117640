"""The fleet's own authority: files, modes, names, days; what it refuses."""

import datetime
import os
import subprocess
import sys
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import rsa
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from safedpa.bus.security.access_control import roles_of
from safedpa.bus.security.certificate_authority import Authority
from safedpa.bus.security.certificates import Certificates
from safedpa.errors import InputError
from safedpa_services.command_line import main


def loaded(path: Path) -> x509.Certificate:
    return x509.load_pem_x509_certificate(path.read_bytes())


def called(*arguments: str) -> int:
    with pytest.raises(SystemExit) as ended:
        main(["certificates", *arguments])
    return int(str(ended.value.code))


def test_every_role_gets_a_certificate_that_names_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert called(str(tmp_path), "--fleet", "f", "--robot", "r1", "--robot", "r2", "--host", "far.example") == 0
    notice = capsys.readouterr().out
    authority = loaded(tmp_path / "authority.pem")
    for role in roles_of(("r1", "r2")):
        assert f"{role}: created, valid for 90 days" in notice
        card = Certificates(tmp_path, role)
        certificate = loaded(card.certificate)
        certificate.verify_directly_issued_by(authority)
        assert certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value == role
        assert not certificate.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
        usage = set(certificate.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value)
        accepts = ExtendedKeyUsageOID.SERVER_AUTH in usage
        assert accepts is (role == "router")
        assert card.key.stat().st_mode & 0o777 == 0o600
    names = loaded(tmp_path / "router.pem").extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert {"localhost", "router", "far.example"} == set(names.get_values_for_type(x509.DNSName))
    assert (tmp_path / "authority.key.pem").stat().st_mode & 0o777 == 0o600


def test_what_is_there_stays_unless_it_is_renewed(tmp_path: Path) -> None:
    folder = str(tmp_path)
    called(folder, "--robot", "r1")
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    called(folder, "--robot", "r1", "--robot", "r2")
    after = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert set(after) - set(before) == {"robot.r2.pem", "robot.r2.key.pem"}
    assert all(after[name] == content for name, content in before.items())
    called(folder, "--robot", "r1", "--renew", "--days", "2")
    renewed = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert renewed["authority.pem"] == before["authority.pem"]
    assert renewed["robot.r1.key.pem"] != before["robot.r1.key.pem"]
    left = loaded(tmp_path / "robot.r1.pem").not_valid_after_utc - datetime.datetime.now(datetime.UTC)
    assert datetime.timedelta(days=1.9) < left <= datetime.timedelta(days=2)


def test_one_fleet_one_authority(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    called(str(tmp_path), "--fleet", "one")
    assert called(str(tmp_path), "--fleet", "other") == 2
    assert "is the authority of fleet 'one', wanted 'other'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("--robot", "a/b"), "name 'a/b'"),
        (("--robot", "r1", "--robot", "r1"), "wanted every robot once"),
        (("--robot", "ä b"), "role 'robot.ä b'"),
        (("--robot", "*"), "name '*'"),
        (("--robot", "-"), "name '-'"),
        (("--days", "0"), "--days: got 0"),
        (("--days", "nan"), "--days: got nan"),
        (("--fleet", "*"), "name '*'"),
    ],
)
def test_what_cannot_be_is_refused(arguments, sentence, tmp_path, capsys):
    assert called(str(tmp_path / "made"), *arguments) == 2
    error = capsys.readouterr().err
    assert sentence in error
    assert error.count("\n") == 1


def test_a_folder_that_cannot_be_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match="choose another folder"):
        Authority(tmp_path / "file" / "below", "f")
    (tmp_path / "authority.key.pem").write_text("no key")
    (tmp_path / "authority.pem").write_text("no certificate")
    with pytest.raises(InputError, match="no certificate and key of an authority"):
        Authority(tmp_path, "f")
    Authority(tmp_path / "good", "f")
    other = rsa.generate_private_key(65537, 2048).private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    (tmp_path / "good" / "authority.key.pem").write_bytes(other)
    with pytest.raises(InputError, match="got another kind of key, wanted one on P-256"):
        Authority(tmp_path / "good", "f")


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (("--role", "policy"), "--role policy: --certificates is missing"),
        (("--certificates", "/nowhere"), "--role is missing"),
        (("--certificates", "/nowhere", "--role", "policy"), "authority.pem: does not exist"),
    ],
)
@pytest.mark.processes
def test_a_process_with_half_an_identity_does_not_start(options: tuple[str, ...], sentence: str) -> None:
    command = [sys.executable, "-m", "safedpa_services.healthcheck", "policy", *options]
    done = subprocess.run(command, capture_output=True, text=True, timeout=30, check=False)
    assert done.returncode == 2
    assert sentence in done.stderr


def test_a_member_can_be_no_authority_and_an_authority_signs_members_alone(tmp_path: Path) -> None:
    """RFC 5280, 4.2.1.9: an authority's basic constraints are critical, and a path of 0 allows none below it."""
    folder = tmp_path / "not" / "there" / "yet"
    authority = Authority(folder, "f")
    authority.issue("policy", 1.0)
    authority.issue("router", 1.0, ("localhost",))
    top = loaded(folder / "authority.pem").extensions.get_extension_for_class(x509.BasicConstraints)
    assert (top.critical, top.value.ca, top.value.path_length) == (True, True, 0)
    for role in ("policy", "router"):
        found = {part.oid: part for part in loaded(folder / f"{role}.pem").extensions}
        constraints = found.pop(x509.BasicConstraints.oid)
        assert (constraints.critical, constraints.value) == (True, x509.BasicConstraints(ca=False, path_length=None))
        assert not any(part.critical for part in found.values()), "who does not know them may pass over them"


def test_an_authority_lasts_ten_years_and_no_certificate_longer(tmp_path: Path) -> None:
    authority = Authority(tmp_path, "f")
    top = loaded(tmp_path / "authority.pem")
    assert top.not_valid_after_utc - top.not_valid_before_utc == datetime.timedelta(days=3650, minutes=5)
    made = loaded(authority.issue("policy", 3650.0))
    assert made.not_valid_after_utc - made.not_valid_before_utc == datetime.timedelta(days=3650, minutes=5)
    with pytest.raises(InputError, match="at most 3650"):
        authority.issue("policy", 3650.5)


def test_a_certificate_is_everybodys_to_read_and_its_owners_alone_to_write(tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        Authority(tmp_path, "f").issue("policy", 1.0)
    finally:
        os.umask(before)
    modes = {path.name: path.stat().st_mode & 0o777 for path in tmp_path.iterdir()}
    assert modes == {
        "authority.pem": 0o644, "authority.key.pem": 0o600, "policy.pem": 0o644, "policy.key.pem": 0o600,
    }  # fmt: skip
