"""The fleet's own authority: files, modes, names, days; what it refuses."""

from __future__ import annotations

import datetime
import subprocess
import sys
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from safedpa.bus.security.access import roles_of
from safedpa.bus.security.authority import Authority
from safedpa.bus.security.certificates import Certificates
from safedpa.errors import BusError, InputError
from safedpa_services.command_line import main


def loaded(path: Path) -> x509.Certificate:
    return x509.load_pem_x509_certificate(path.read_bytes())


def called(*arguments: str) -> int:
    with pytest.raises(SystemExit) as ended:
        main(["certificates", *arguments])
    return int(str(ended.value.code))


def test_every_role_gets_a_certificate_that_names_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert called(str(tmp_path), "--fleet", "f", "--robot", "r1", "--robot", "r2", "--host", "far.example") == 0
    said = capsys.readouterr().out
    authority = loaded(tmp_path / "authority.pem")
    for role in roles_of(("r1", "r2")):
        assert f"{role}: made, good for 90 days" in said
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
def test_what_cannot_be_is_refused(
    arguments: tuple[str, ...], sentence: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
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


def test_missing_files_are_named_with_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(BusError, match=r"authority\.pem: is not there; make it with 'safedpa certificates"):
        Certificates(tmp_path, "policy")
    with pytest.raises(BusError, match="got no --role"):
        Certificates(tmp_path, "")


def test_a_key_that_everybody_can_read_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Authority(tmp_path, "f").issue("policy", 1.0)
    Certificates(tmp_path, "policy")
    assert capsys.readouterr().err == ""
    (tmp_path / "policy.key.pem").chmod(0o644)
    Certificates(tmp_path, "policy")
    assert '"kind": "bus.key_exposed"' in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (("--role", "policy"), "--role policy: got no --certificates"),
        (("--certificates", "/nowhere"), "got no --role"),
        (("--certificates", "/nowhere", "--role", "policy"), "authority.pem: is not there"),
    ],
)
@pytest.mark.processes
def test_a_process_with_half_an_identity_does_not_start(options: tuple[str, ...], sentence: str) -> None:
    command = [sys.executable, "-m", "safedpa_services.healthcheck", "policy", *options]
    done = subprocess.run(command, capture_output=True, text=True, timeout=30, check=False)
    assert done.returncode == 2
    assert sentence in done.stderr
