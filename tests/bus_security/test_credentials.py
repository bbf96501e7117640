"""A process's proof of who it is: three files, or a card that it is handed by a pipe; and its memory is its own."""

import base64
import ctypes
import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from safedpa.bus.security.certificate_authority import Authority
from safedpa.bus.security.certificates import Certificates, PemCredentials, protect_process_memory
from safedpa.errors import BusError

PEM = b"-----BEGIN "


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    Authority(tmp_path, "f").issue("policy", 1.0)
    return tmp_path


@pytest.mark.parametrize("gone", ["authority", "policy", "policy.key"])
def test_a_missing_file_is_named_with_the_command_that_makes_it(gone: str, folder: Path) -> None:
    assert PemCredentials.of(folder, "policy").role == "policy"
    with pytest.raises(BusError, match=r"--role is missing, wanted the role of the certificate, such as robot.r1"):
        Certificates(folder, "")
    (folder / f"{gone}.pem").unlink()
    with pytest.raises(BusError, match=rf"{gone}.pem: does not exist; create it with 'safedpa certificates"):
        Certificates(folder, "policy")


@pytest.mark.parametrize(
    ("mode", "exposed"), [(0o600, False), (0o640, False), (0o604, True), (0o602, True), (0o601, True)]
)
def test_a_key_that_others_than_its_group_can_use_is_reported(folder, capsys, mode, exposed):
    (folder / "policy.key.pem").chmod(mode)
    Certificates(folder, "policy")
    assert ('"kind": "bus.key_exposed"' in capsys.readouterr().err) is exposed


@pytest.mark.parametrize(
    ("parts", "taken"),
    [
        ((PEM + b"A", PEM + b"B", PEM + b"C"), True),
        ((PEM, PEM), False),
        ((PEM,) * 4, False),
        ((PEM, PEM, b"C"), False),
        ((PEM, b"B", PEM), False),
        ((b"", PEM, PEM), False),
        ((b"",), False),
    ],
)
def test_a_card_has_three_parts_all_of_them_in_pem(parts: tuple[bytes, ...], taken: bool) -> None:
    reading, writing = os.pipe()
    os.write(writing, b"\0".join(parts))
    os.close(writing)
    if taken:
        card = PemCredentials.from_descriptor(reading, "policy")
        assert (card.role, card.authority, card.certificate, card.key) == ("policy", *parts)
        assert b"-BEGIN C".decode() not in repr(card), "the key is in no message"
    else:
        with pytest.raises(BusError, match=f"--card {reading}: .* wanted authority, certificate and key"):
            PemCredentials.from_descriptor(reading, "policy")
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(reading)


def test_a_card_of_64_kib_is_read_whole() -> None:
    """A pipe holds as much; a longer one is cut, and refused."""
    long = PEM + b"x" * 20_000
    assert PemCredentials.from_descriptor(PemCredentials("policy", long, long, long).pipe(), "policy").key == long


def test_a_card_holds_what_the_files_hold(folder: Path) -> None:
    files, card = Certificates(folder, "policy").tls(), PemCredentials.of(folder, "policy")
    assert {name: base64.b64decode(value) for name, value in card.tls().items()} == {
        f"{name}_base64": Path(value).read_bytes() for name, value in files.items()
    }
    assert "PRIVATE" not in repr(card)


@pytest.mark.parametrize(("result", "closed"), [(0, True), (-1, False), (1, False)])
def test_memory_is_closed_where_the_kernel_says_so(monkeypatch: pytest.MonkeyPatch, result: int, closed: bool) -> None:
    """prctl(2): PR_SET_DUMPABLE is 4, SUID_DUMP_DISABLE 0; with anything behind them it may answer EINVAL."""
    asked: list[tuple[int, ...]] = []
    monkeypatch.setattr(ctypes, "CDLL", lambda _: SimpleNamespace(prctl=lambda *given: asked.append(given) or result))
    assert protect_process_memory() is closed
    assert asked == [(4, 0, 0, 0, 0)]


@pytest.mark.parametrize("library", [SimpleNamespace(), None])
def test_where_the_system_has_no_such_call_memory_stays_open(monkeypatch: pytest.MonkeyPatch, library: Any) -> None:
    def opened(_: None) -> Any:
        if library is None:
            raise OSError("no library")
        return library

    monkeypatch.setattr(ctypes, "CDLL", opened)
    assert protect_process_memory() is False
